"""Survival: large motions, lost scans, other places. Errors are noise, and what is not known is said."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from scanloom.schemas.product import columns_of
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from tests.stages.odometry.drives import Drive, drive_along, end_error_m, step_errors
from tests.worlds import observe, street

START_NS = 1_700_000_000_000_000_000


def without_sensors(poses: list[F8], period_s: float, seed: int = 2, rows: int = 16) -> Drive:
    """A LiDAR alone at given poses in a street."""
    rng = np.random.default_rng(seed)
    scans = [
        observe(street(seed), T, index=k, stamp_ns=START_NS + round(1e9 * period_s * k), rng=rng, rows=rows)
        for k, T in enumerate(poses)
    ]
    return Drive(scans, np.array(poses), Imu.empty(), Wheel.empty())


def straight(step_m: float, count: int) -> list[F8]:
    return [pose(np.eye(3), [step_m * k, 0, 0]) for k in range(count)]


def turning(step_rad: float, count: int, seed: int) -> list[F8]:
    """Turns of one size to either side, by chance, while walking."""
    rng, poses = np.random.default_rng(seed), [np.eye(4)]
    for _ in range(count - 1):
        turn = pose(so3_exp([0, 0, step_rad * rng.choice([-1, 1])]), [0.3, 0, 0])
        poses.append(poses[-1] @ turn)
    return poses


def tumbling(step_rad: float, count: int, seed: int) -> list[F8]:
    """Level in every second scan, turned about any axis in the others."""
    rng, poses = np.random.default_rng(seed), []
    for k in range(count):
        w = rng.normal(size=3) * (0.6, 0.6, 1.0)
        R = so3_exp(step_rad * w / np.linalg.norm(w)) if k % 2 else np.eye(3)
        poses.append(pose(R, [0.15 * k, 0.05 * rng.normal() if k else 0.0, 0.0]))
    return poses


def nees(track: Odometry, truth: F8) -> F8:
    errors = step_errors(track, truth)
    return np.array([e @ np.linalg.solve(C, e) for e, C in zip(errors, track.covariance[1:], strict=True)])


@pytest.mark.parametrize("step_m", [2.4, 5.0, 8.0])
def test_two_scans_a_second_are_followed_from_the_first(step_m: float) -> None:
    """At 8 m a step the drive begins at 16 m/s, which nothing announces."""
    ride = without_sensors(straight(step_m, 14), 0.5)
    track = ride.run(sensors=False)
    error = np.linalg.norm(step_errors(track, ride.truth)[:, 3:], axis=1)
    assert track.reliable.all()
    assert error.max() < 0.05
    assert 0.0005 < np.sqrt((error**2).mean()) < 0.03
    assert not track.segment.any()


@pytest.mark.parametrize("seed", [2, 7])
def test_turns_of_48_degrees_between_scans_are_followed(seed: int) -> None:
    ride = without_sensors(turning(np.radians(48), 14, seed), 0.1, seed)
    track = ride.run(sensors=False)
    error = step_errors(track, ride.truth)
    assert track.reliable.all()
    assert 1e-5 < np.sqrt((error[:, :3] ** 2).sum(axis=1).mean()) < np.radians(0.2)
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 0.03


def test_turns_about_any_axis_end_where_they_should() -> None:
    """Scans that are not found are marked; those after them are right again."""
    ride = without_sensors(tumbling(np.radians(48), 12, 2), 0.1, rows=32)
    track = ride.run(sensors=False)
    off = np.linalg.norm((track.T_odom_lidar - ride.truth)[:, :3, 3], axis=1)
    assert track.reliable.mean() >= 0.75
    assert off[track.reliable].max() < 0.05
    assert end_error_m(track, ride.truth) < 0.05
    assert not track.segment.any()


def with_strange_scans(ride: Drive, first: int, count: int) -> Drive:
    """Scans of another street in the place of some."""
    rng, scans = np.random.default_rng(9), list(ride.scans)
    for k in range(first, first + count):
        T = pose(so3_exp([0, 0, 2.0]), [55.0 + k, 3.5, 0])
        scans[k] = observe(
            street(9), T, index=scans[k].scan_index, stamp_ns=scans[k].reference_ns, rng=rng, rows=24
        )
    return dataclasses.replace(ride, scans=scans)


@pytest.mark.parametrize("sensors", [True, False])
@pytest.mark.parametrize("count", [1, 3])
def test_a_scan_of_elsewhere_is_marked_and_never_a_jump(sensors: bool, count: int) -> None:
    ride = with_strange_scans(drive_along(street(5), 32), 20, count)
    track = ride.run(sensors=sensors)
    np.testing.assert_array_equal(np.flatnonzero(~track.reliable), np.arange(20, 20 + count))
    error = np.linalg.norm(step_errors(track, ride.truth)[:, 3:], axis=1)
    assert error.max() < 0.05, "the motion goes on through the strange scans, and the rest is right"
    assert not track.segment.any()
    bridged = np.sqrt(track.covariance[20 : 20 + count, 3, 3])
    assert (bridged > 0.002).all()
    assert nees(track, ride.truth).max() < 40


def without_scans(ride: Drive, first: int, last: int) -> Drive:
    kept = [k for k in range(len(ride.scans)) if not first <= k < last]
    return dataclasses.replace(ride, scans=[ride.scans[k] for k in kept], truth=ride.truth[kept])


@pytest.mark.parametrize("seed", [5, 7])
def test_three_seconds_without_scans_are_bridged_by_wheels(seed: int) -> None:
    ride = without_scans(drive_along(street(seed), 60), 15, 45)
    track = ride.run()
    error = step_errors(track, ride.truth)
    assert np.linalg.norm(error[14, 3:]) < 0.3, "one per cent of wheel scale over 31 m"
    assert np.linalg.norm(np.delete(error, 14, axis=0)[:, 3:], axis=1).max() < 0.05
    assert not track.segment.any()
    assert track.reliable[-5:].all()
    assert nees(track, ride.truth)[14] < 25


@pytest.mark.parametrize("seed", [5, 7])
def test_three_seconds_without_scans_and_sensors_are_not_hidden(seed: int) -> None:
    """Found again in the map, or a new segment: either way the doubt over the gap covers its error."""
    ride = without_scans(drive_along(street(seed), 60), 15, 45)
    track = ride.run(sensors=False)
    across = step_errors(track, ride.truth)[14]
    assert np.linalg.norm(across[3:]) < 5.0
    assert across @ np.linalg.solve(track.covariance[15], across) < 25
    assert track.reliable[-5:].all()
    if track.segment.any():
        assert not track.reliable[np.flatnonzero(np.diff(track.segment)) + 1].any()


def test_another_place_begins_another_segment() -> None:
    """After a pause of eight seconds the scans show another street: nothing tells the motion to it."""
    first, second = drive_along(street(5), 20), drive_along(street(25), 20)
    late = [
        dataclasses.replace(s, reference_ns=s.reference_ns + 10**10, scan_index=20 + k)
        for k, s in enumerate(second.scans)
    ]
    ride = dataclasses.replace(
        first, scans=first.scans + late, truth=np.concatenate((first.truth, second.truth))
    )
    track = ride.run(sensors=False)
    border = np.flatnonzero(np.diff(track.segment)) + 1
    assert len(border) == 1
    assert 20 <= border[0] <= 24
    assert not track.reliable[border[0]]
    assert track.keyframe[border[0]]
    assert track.keyframe[border[0] - 1]
    wide = np.sqrt(track.covariance[20].diagonal())
    assert (wide[3:] > 50).all()
    inner = np.linalg.norm(step_errors(track, ride.truth)[:, 3:], axis=1)
    assert inner[:19].max() < 0.05
    assert inner[border[0] :].max() < 0.05
    assert track.reliable[border[0] + 1 :].all()


def test_a_lost_drive_is_the_same_bytes_in_any_chunks() -> None:
    ride = with_strange_scans(drive_along(street(5), 24), 12, 2)
    a, b = ride.run(chunk=5, sensors=False), ride.run(chunk=24, sensors=False)
    for name in columns_of(Odometry):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
