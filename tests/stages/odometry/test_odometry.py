"""Odometry on analytic drives: two-sided error bounds, honesty about what it does not see, damage."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import columns_of
from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import pose, so3_exp
from scanloom.stages.odometry import Settings, odometry
from scanloom.stages.odometry.prediction import Predictor
from scanloom.stages.odometry.thinning import Thinner, surface_share
from tests.stages.odometry.drives import (
    Drive,
    drive_along,
    end_error_m,
    endless_tunnel,
    labelled,
    parts,
    session,
    step_errors,
    tunnel_between_streets,
)
from tests.worlds import observe, street


@pytest.fixture(scope="module")
def street_drive() -> Drive:
    return drive_along(street(2), 40)


@pytest.fixture(scope="module")
def street_track(street_drive: Drive) -> Odometry:
    return street_drive.run()


def test_every_scan_has_a_row_and_odom_starts_at_identity(
    street_drive: Drive, street_track: Odometry
) -> None:
    np.testing.assert_array_equal(street_track.scan_index, np.arange(40))
    np.testing.assert_array_equal(street_track.stamp_ns, [s.reference_ns for s in street_drive.scans])
    np.testing.assert_array_equal(street_track.T_odom_lidar[0], np.eye(4))
    assert street_track.reliable.all()
    assert street_track.keyframe[0]
    assert 15 < street_track.keyframe.sum() <= 40


def test_errors_lie_between_noise_bounds(street_drive: Drive, street_track: Odometry) -> None:
    error = step_errors(street_track, street_drive.truth)
    assert 0.0005 < np.sqrt((error[:, 3:] ** 2).sum(axis=1).mean()) < 0.01
    assert 1e-5 < np.sqrt((error[:, :3] ** 2).sum(axis=1).mean()) < 1e-3
    assert end_error_m(street_track, street_drive.truth) < 0.06
    assert 0.01 < np.median(street_track.rmse_m[1:]) < 0.04


def test_covariance_explains_the_errors(street_drive: Drive, street_track: Odometry) -> None:
    errors = step_errors(street_track, street_drive.truth)
    nees = [e @ np.linalg.solve(C, e) for e, C in zip(errors, street_track.covariance[1:], strict=True)]
    assert 0.6 < np.mean(nees) < 18, "6 is perfect, below is cautious"
    assert np.linalg.eigvalsh(street_track.covariance).min() > 0


def test_without_other_sensors_it_still_works(street_drive: Drive) -> None:
    track = street_drive.run(sensors=False)
    assert track.reliable.all()
    assert end_error_m(track, street_drive.truth) < 0.06


def test_fast_starts_and_sharp_turns_are_followed() -> None:
    fast = drive_along(street(5), 12, step_m=2.5)
    track = fast.run(sensors=False)
    assert track.reliable.all()
    assert end_error_m(track, fast.truth) < 0.06


def test_same_input_same_bytes_in_any_chunks(street_drive: Drive) -> None:
    short = dataclasses.replace(street_drive, scans=street_drive.scans[:8])
    a, b = short.run(chunk=3), short.run(chunk=8)
    for name in columns_of(Odometry):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def test_standing_still_does_not_drift() -> None:
    still = drive_along(street(2), 25, step_m=0.0)
    for sensors in (True, False):
        track = still.run(sensors=sensors)
        moved = np.linalg.norm(track.T_odom_lidar[:, :3, 3], axis=1)
        assert moved.max() < 0.02
        assert moved[15:].mean() < 0.01
        assert track.reliable.all()
        assert track.keyframe.sum() <= 2


def test_wheels_carry_through_a_tunnel_and_their_scale_is_learned() -> None:
    ride = drive_along(tunnel_between_streets(), 115)
    track = ride.run()
    errors = np.linalg.norm(track.T_odom_lidar[:, :3, 3] - ride.truth[:, :3, 3], axis=1)
    assert errors.max() < 0.3, "1 % of wheel scale alone would be 1.1 m"
    assert track.reliable.mean() > 0.95


def test_an_endless_tunnel_is_flagged_along_its_axis() -> None:
    ride = drive_along(endless_tunnel(), 20, wheel_scale=0.995)
    track = ride.run()
    assert (track.direction_p[1:, 0] < 0.9).all()
    assert (track.direction_p[1:, 1:] > 0.9).all()
    assert (np.abs(track.weak_directions[1:, 3, 0]) > 0.9).all()
    along, across = np.sqrt(track.covariance[1:, 3, 3]), np.sqrt(track.covariance[1:, 4, 4])
    assert (along > 0.01).all()
    assert (across < 0.01).all()
    drift = 19 - track.T_odom_lidar[-1, 0, 3]
    assert 0.05 < drift < 0.15, "what half a percent of wheel scale gives, no more and no less"
    blind = ride.run(sensors=False)
    assert (np.sqrt(blind.covariance[1:, 3, 3]) > 1.0).all(), "nothing tells the speed, and it is said"


def test_the_street_is_well_seen(street_track: Odometry) -> None:
    assert street_track.direction_p[1:].min() > 0.9
    assert street_track.degeneracy_d[1:].min() > 0.02
    assert street_track.degeneracy_e[1:].max() < 0.02


def test_a_scan_from_elsewhere_and_an_empty_one_are_bridged(street_drive: Drive) -> None:
    scans = list(street_drive.scans)
    stray = observe(street(9), pose(so3_exp([0, 0, 0.7]), [20, 3, 0]), rows=24, columns=512)
    scans[15] = dataclasses.replace(stray, reference_ns=scans[15].reference_ns, scan_index=15)
    scans[20] = DeskewedScan.empty(reference_ns=scans[20].reference_ns, scan_index=20)
    for sensors in (True, False):
        track = dataclasses.replace(street_drive, scans=scans).run(sensors=sensors)
        np.testing.assert_array_equal(np.flatnonzero(~track.reliable), [15, 20])
        steps = np.linalg.norm(step_errors(track, street_drive.truth)[:, 3:], axis=1)
        assert steps.max() < 0.15, "no jump"
        assert end_error_m(track, street_drive.truth) < 0.08
        assert track.inlier_ratio[20] == 0
        assert track.covariance[15, 3, 3] > track.covariance[14, 3, 3]


def test_moving_and_own_points_are_not_used(street_drive: Drive) -> None:
    rng = np.random.default_rng(0)
    scans, labels = [], []
    for scan in street_drive.scans[:12]:
        wall = np.column_stack(
            (np.full(3000, 3.0), rng.uniform(-3, 3, 3000), rng.uniform(-1, 2, 3000))
        ).astype(np.float32)
        extra = dataclasses.replace(
            scan.take(np.arange(3000) % len(scan)),
            x_m=wall[:, 0].copy(),
            y_m=wall[:, 1].copy(),
            z_m=wall[:, 2].copy(),
        )
        scans.append(DeskewedScan.concatenate([scan, extra]))
        kinds = rng.choice(
            [PointClass.DYNAMIC, PointClass.EGO, PointClass.AIRBORNE, PointClass.OUTLIER], 3000
        )
        label = labelled(scan)
        labels.append(
            dataclasses.replace(label, class_=np.concatenate((label.class_, kinds.astype(np.uint8))))
        )
    track = odometry(
        Settings(), parts(scans, 5), parts(labels, 5), session(), street_drive.imu, street_drive.wheel
    )
    clean = dataclasses.replace(street_drive, scans=street_drive.scans[:12]).run()
    np.testing.assert_array_equal(track.T_odom_lidar, clean.T_odom_lidar)


def test_wheel_slip_is_not_learned(street_drive: Drive) -> None:
    predictor = Predictor(session(), street_drive.imu, street_drive.wheel)
    stamps = [s.reference_ns for s in street_drive.scans]
    for a, b in itertools.pairwise(stamps):
        predictor.learn(a, b, pose(np.eye(3), [1.0, 0, 0]), well_seen=True)
    learned = predictor.wheel_scale
    assert 1.004 < learned < 1.0102
    predictor.learn(stamps[-2], stamps[-1], pose(np.eye(3), [0.5, 0, 0]), well_seen=True)
    assert predictor.wheel_scale == learned


@pytest.mark.parametrize("count", [0, 1])
def test_too_short_a_log_is_an_error_with_advice(street_drive: Drive, count: int) -> None:
    with pytest.raises(StageError, match="at least two scans") as caught:
        dataclasses.replace(street_drive, scans=street_drive.scans[:count]).run()
    assert caught.value.next_step


def test_stamps_that_go_back_and_foreign_labels_are_errors(street_drive: Drive) -> None:
    scans = street_drive.scans[:3]
    back = [scans[0], scans[2], scans[1]]
    with pytest.raises(StageError, match="not later"):
        dataclasses.replace(street_drive, scans=back).run()
    with pytest.raises(StageError, match="do not belong"):
        odometry(
            Settings(),
            parts(scans, 3),
            parts([labelled(s) for s in back], 3),
            session(),
            street_drive.imu,
            street_drive.wheel,
        )


@pytest.mark.real
def test_kitti_path_length(shared_data: Path) -> None:
    """Scan registration and OXTS speed agree on 38.9 m for the whole; its first 30 scans are about 10 m."""
    files = sorted((shared_data / "kitti_raw_0005").rglob("velodyne_points/data/*.bin"))[:30]
    scans = []
    for k, file in enumerate(files):
        xyzr = np.fromfile(file, np.float32).reshape(-1, 4)
        stamp = k * 103_500_000
        scans.append(
            DeskewedScan(
                x_m=xyzr[:, 0].copy(), y_m=xyzr[:, 1].copy(), z_m=xyzr[:, 2].copy(),
                intensity=xyzr[:, 3].copy(),
                reference_ns=stamp, scan_index=k,
            )
        )  # fmt: skip
    track = Drive(scans, np.zeros((0, 4, 4)), None, None).run(sensors=False)  # type: ignore[arg-type]
    length = np.linalg.norm(np.diff(track.T_odom_lidar[:, :3, 3], axis=0), axis=1).sum()
    assert track.reliable.all()
    assert 9.0 < length < 11.0


def test_slip_in_a_tunnel_is_bounded_by_the_accelerometer() -> None:
    """Half a second in which the wheels turn 40 % too fast would be 2 m; nothing but the IMU can tell."""
    ride = drive_along(endless_tunnel(), 30, wheel_scale=1.0)
    since_s = 1e-9 * (ride.wheel.stamp_ns - ride.scans[0].reference_ns)
    slipping = (since_s > 1.5) & (since_s < 2.0)
    wheel = dataclasses.replace(ride.wheel, speed_m_s=ride.wheel.speed_m_s * np.where(slipping, 1.4, 1.0))
    track = dataclasses.replace(ride, wheel=wheel).run()
    off = track.T_odom_lidar[-1, 0, 3] - 29
    assert 0.02 < off < 0.6
    steady = track.covariance[10, 3, 3]
    assert track.covariance[17, 3, 3] > 4 * steady, "slip is said in the covariance"


def test_minutes_of_standing_drift_by_less_than_two_centimetres() -> None:
    """Two minutes at 10 Hz, the same hundred scans again and again, in random order so that noise does not repeat."""
    still = drive_along(street(2), 60, step_m=0.0)
    order = np.random.default_rng(0).integers(0, 60, 1200)
    start = still.scans[0].reference_ns
    scans = [
        dataclasses.replace(still.scans[k], reference_ns=start + i * 100_000_000, scan_index=i)
        for i, k in enumerate(order)
    ]
    track = dataclasses.replace(still, scans=scans).run(sensors=False, chunk=200)
    way = np.linalg.norm(track.T_odom_lidar[:, :3, 3], axis=1)
    assert way.max() < 0.02
    assert 0 < way[-100:].mean() < 0.01
    assert track.reliable.all()
    assert track.keyframe.sum() == 1 + 119 // 5, "one every five seconds"


@pytest.mark.parametrize("change", [{"residual": "plane_to_plane"}, {"indicator": "E2"}, {"indicator": "E3"}])
def test_the_forms_of_residual_and_of_e(
    street_drive: Drive, street_track: Odometry, change: dict[str, str]
) -> None:
    short = dataclasses.replace(street_drive, scans=street_drive.scans[:12])
    track = short.run(Settings(**change))
    assert track.reliable.all()
    assert end_error_m(track, street_drive.truth[:12]) < 0.05
    assert (track.degeneracy_e[1:] > 0).all()
    if "indicator" in change:
        np.testing.assert_array_equal(track.T_odom_lidar, street_track.T_odom_lidar[:12])
        assert (track.degeneracy_e[1:] > street_track.degeneracy_e[1:12]).all()


def first_thinned(scan: DeskewedScan) -> np.ndarray:
    """What the first scan is judged by: not yet thinned as dense scans are."""
    return Thinner(Settings(dense_share=1.0)).thin(scan, labelled(scan)).fine


def test_dense_scans_get_a_finer_map(street_drive: Drive) -> None:
    scan = observe(street(2), np.eye(4), rng=np.random.default_rng(0), rows=64, columns=1024)
    for scans, wanted in ((scan, 0.6), (street_drive.scans[0], 1.0)):
        thinned = Thinner(Settings(dense_share=0.2)).thin(scans, labelled(scans))
        share = surface_share(first_thinned(scans), 0.7)
        assert thinned.voxel_size_m == (0.6 if share >= 0.2 else 1.0) == wanted
    exact = surface_share(first_thinned(scan), 0.7)
    for limit, wanted in ((exact, 0.6), (np.nextafter(exact, 1), 1.0)):
        assert Thinner(Settings(dense_share=limit)).thin(scan, labelled(scan)).voxel_size_m == wanted
    empty = DeskewedScan.empty(reference_ns=0, scan_index=0)
    thinner = Thinner(Settings(dense_share=0.2))
    assert thinner.thin(empty, labelled(empty)).voxel_size_m == 1.0
    assert thinner.thin(scan, labelled(scan)).voxel_size_m == 0.6, "an empty first scan decides nothing"
