"""Deskew against exact truth: sweeps taken while moving through an analytic world, with sensors made from the motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from scanloom.schemas.scans import DeskewedScan, Scan, Scans
from scanloom.schemas.session import Extrinsic, Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.deskew import Settings, deskew
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.se3 import F8, adjoint, inverse, pose, se3_exp, so3_exp, transform
from tests.worlds import BoxWorld, street, sweep, sweep_along

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
GRAVITY = np.array([0.0, 0.0, 9.81])
T_BASE_LIDAR = pose(so3_exp([0.02, -0.03, 0.2]), [1.2, 0.1, 1.8])
T_BASE_IMU = pose(so3_exp([0.0, 0.0, np.pi / 2]), [0.4, -0.3, 0.5])
BIAS = np.array([0.01, -0.02, 0.015])
SETTINGS = Settings()


def make_session(point_time: str = "per point", mounted: bool = False) -> Session:
    mounts = {"lidar": T_BASE_LIDAR, "imu": T_BASE_IMU} if mounted else {}
    extrinsics = tuple(
        Extrinsic(sensor=name, T_base_sensor=tuple(map(tuple, T.tolist())), source="test")
        for name, T in mounts.items()
    )
    return Session(
        name="test", format="mcap", start_ns=START_NS, end_ns=START_NS + 10**9, scan_count=1, point_count=1,
        scan_rate_hz=10.0, beams=16, point_time=point_time, topics=(), extrinsics=extrinsics, problems=(), complete=True,
    )  # fmt: skip


def sensors(
    twist_base: F8, *, bias: F8 = BIAS, T_base_imu: F8 = T_BASE_IMU, wheel_noise: float = 0.0
) -> tuple[Imu, Wheel]:
    """Five seconds of standing, then the twist of the base; 100 Hz IMU, 50 Hz wheel."""
    rng = np.random.default_rng(3)
    imu_ns = START_NS + np.arange(-520, 300) * 10_000_000
    wheel_ns = START_NS + np.arange(-260, 150) * 20_000_000
    moves = (imu_ns > START_NS - 200_000_000)[:, None]
    gyro = (
        np.where(moves, twist_base[:3], 0.0) @ T_base_imu[:3, :3]
        + bias
        + rng.normal(0, 0.002, (len(imu_ns), 3))
    )
    accel = np.tile(GRAVITY @ T_base_imu[:3, :3], (len(imu_ns), 1)) + rng.normal(0, 0.02, (len(imu_ns), 3))
    speed = np.where(wheel_ns > START_NS - 200_000_000, twist_base[3], 0.0)
    speed = speed + rng.normal(0, wheel_noise, len(speed))
    return Imu(imu_ns, gyro, accel), Wheel(wheel_ns, speed, np.full(len(wheel_ns), np.nan))


def run(
    scans: list[Scan],
    session: Session,
    imu: Imu | None = None,
    wheel: Wheel | None = None,
    **settings: object,
) -> list[DeskewedScan]:
    out = deskew(Settings(**settings), Scans(scans), session, imu or Imu.empty(), wheel or Wheel.empty())
    return [*iter(out)]


def moving_scans(
    twist: F8, count: int, world: BoxWorld, *, noise_m: float = 0.01, rows: int = 16, columns: int = 512
) -> tuple[list[Scan], F8]:
    """Scans and their true poses while moving with a constant twist of the LiDAR."""
    rng = np.random.default_rng(5)
    poses = np.array([se3_exp(0.1 * i * twist) for i in range(count)])
    scans = [
        sweep(world, T, twist, index=i, stamp_ns=START_NS + i * PERIOD_NS, rng=rng, noise_m=noise_m, rows=rows, columns=columns)
        for i, T in enumerate(poses)
    ]  # fmt: skip
    return scans, poses


def exact(scan: Scan, twist: F8) -> F8:
    """True coordinates (n, 3) in the LiDAR frame at the reference time."""
    dt = 1e-9 * (scan.stamp_ns - scan.reference_ns)
    T = se3_exp(dt[:, None] * twist)
    return np.einsum("nij,nj->ni", T[:, :3, :3], scan.points().astype(float)) + T[:, :3, 3]


def rms(a: F8) -> float:
    return float(np.sqrt(np.mean(np.sum(np.atleast_2d(a.T).T ** 2, axis=1))))


def wall_rms(points: F8, T_world_lidar: F8) -> float:
    """Distance of the points of the wall at y = 15 m to it."""
    world = transform(T_world_lidar, points)
    on_wall = (np.abs(world[:, 1] - 15.0) < 3.0) & (world[:, 2] > -1.0)
    assert on_wall.sum() > 500
    return float(np.sqrt(np.mean((world[on_wall, 1] - 15.0) ** 2)))


WALL = BoxWorld(np.array([[[-200.0, 15.0, -5.0], [200.0, 16.0, 20.0]]]))


def test_flat_wall_at_20_m_s_and_30_deg_s_stays_flat() -> None:
    base = np.array([0, 0, np.radians(30), 20.0, 0, 0])
    twist = adjoint(inverse(T_BASE_LIDAR)) @ base
    scans, poses = moving_scans(twist, 1, WALL)
    imu, wheel = sensors(base)
    (flat,) = run(scans, make_session(mounted=True), imu, wheel)
    ideal = exact(scans[0], twist)
    floor = wall_rms(ideal, poses[0])
    found = wall_rms(flat.points(), poses[0])
    assert 0.9 * floor < found < 0.02
    assert found < 1.3 * floor
    assert wall_rms(scans[0].points(), poses[0]) > 0.2  # the sweep is distorted indeed
    assert 1e-5 < rms(flat.points() - ideal) < 0.01


@pytest.mark.parametrize("speed", [3.0, 15.0])
def test_without_sensors_neighbours_tell_the_motion(speed: float) -> None:
    twist = np.array([0, 0, np.radians(20), speed, 0, 0])
    scans, _ = moving_scans(twist, 4, street(1))
    out = run(scans, make_session())
    for scan, flat in zip(scans, out):
        before, after = rms(scan.points() - exact(scan, twist)), rms(flat.points() - exact(scan, twist))
        assert 1e-4 < after < 0.05
        assert after < 0.25 * before


def test_the_motion_that_was_registered_is_handed_on() -> None:
    base = np.array([0, 0, np.radians(20), 15.0, 0, 0])
    twist = adjoint(inverse(T_BASE_LIDAR)) @ base
    scans, _ = moving_scans(twist, 4, street(1))
    out = run(scans, make_session(mounted=True))
    for flat in out[:-1]:
        off = np.abs(np.array(flat.next_twist) - twist)
        assert 0.0 < off[:3].max() < 0.02
        assert 0.0 < off[3:].max() < 0.3
    assert out[-1].next_twist == ()  # none follows
    assert all(flat.next_twist == () for flat in run(scans, make_session(mounted=True), *sensors(base)))
    assert all(flat.next_twist == () for flat in run(scans, make_session(), motion="none"))
    assert all(flat.next_twist == () for flat in run(scans, make_session(), motion="sensors"))


def test_a_turn_rate_that_changes_within_the_sweep_is_followed() -> None:
    def path(at_s: F8) -> F8:
        yaw = 0.25 * np.sin(2 * np.pi * 0.8 * at_s)  # up to 6 rad/s2, a hand that looks around
        return pose(
            so3_exp(yaw[:, None] * np.array([0, 0, 1.0])), np.column_stack((1.5 * at_s, 0 * at_s, 0 * at_s))
        )

    rng = np.random.default_rng(6)
    middles = 0.1 * np.arange(10)
    scans = [
        sweep_along(street(5), path, t, index=i, stamp_ns=START_NS + i * PERIOD_NS, rng=rng, noise_m=0.01)
        for i, t in enumerate(middles)
    ]
    left, distorted = [], []
    for t, scan, flat in list(zip(middles, scans, run(scans, make_session())))[1:-1]:
        at_s = t + 1e-9 * (scan.stamp_ns - scan.reference_ns)
        T = inverse(path(np.array([t])))[0] @ path(at_s)
        true = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points().astype(float)) + T[:, :3, 3]
        left.append(rms(flat.points() - true))
        distorted.append(rms(scan.points() - true))
    assert np.mean(distorted) > 0.3
    assert 0.005 < np.mean(left) < 0.2 * np.mean(distorted)


def test_gyro_alone_leaves_only_translation_to_the_neighbours() -> None:
    twist = np.array([0, 0, np.radians(40), 8.0, 0, 0])
    scans, _ = moving_scans(twist, 3, street(2))
    imu, _ = sensors(twist, T_base_imu=np.eye(4))
    for scan, flat in zip(scans, run(scans, make_session(), imu)):
        assert 1e-4 < rms(flat.points() - exact(scan, twist)) < 0.05


def test_wheel_alone_leaves_only_rotation_to_the_neighbours() -> None:
    twist = np.array([0, 0, np.radians(25), 9.0, 0, 0])
    scans, _ = moving_scans(twist, 3, street(2))
    _, wheel = sensors(twist)
    for scan, flat in zip(scans, run(scans, make_session(), None, wheel)):
        assert 1e-4 < rms(flat.points() - exact(scan, twist)) < 0.05


def test_standing_returns_the_input_bit_for_bit() -> None:
    scans, _ = moving_scans(np.zeros(6), 2, street(0))
    imu, wheel = sensors(np.zeros(6), bias=np.zeros(3))
    still = dataclasses.replace(imu, gyro_rad_s=np.zeros_like(imu.gyro_rad_s))
    for session in (make_session(), make_session(mounted=True)):
        for scan, flat in zip(scans, run(scans, session, still, wheel)):
            assert flat.points().tobytes() == scan.points().tobytes()


@pytest.mark.parametrize("case", ["no point time", "equal stamps", "switched off"])
def test_scans_without_time_pass_unchanged(case: str) -> None:
    twist = np.array([0, 0, 0.5, 10.0, 0, 0])
    scans, _ = moving_scans(twist, 2, street(0))
    imu, wheel = sensors(twist)
    if case == "equal stamps":
        scans = [dataclasses.replace(s, stamp_ns=np.full(len(s), s.reference_ns - 50_000_000)) for s in scans]
    session = make_session("none" if case == "no point time" else "per point")
    settings = {"motion": "none"} if case == "switched off" else {}
    for scan, flat in zip(scans, run(scans, session, imu, wheel, **settings)):
        assert flat.points().tobytes() == scan.points().tobytes()
        assert flat.reference_ns == scan.reference_ns


@pytest.mark.parametrize(
    "damage", ["imu ends early", "gyro gap", "imu upside down", "nan rows", "repeated stamps", "wheel gap"]
)
def test_damaged_sensors_are_survived(damage: str) -> None:
    twist = np.array([0, 0, np.radians(20), 10.0, 0, 0])
    scans, _ = moving_scans(twist, 3, street(3))
    imu, wheel = sensors(twist, T_base_imu=np.eye(4))
    late = imu.stamp_ns > START_NS - 100_000_000
    if damage == "imu ends early":
        imu = imu.take(imu.stamp_ns < START_NS - 10**9)
    elif damage == "gyro gap":
        imu = imu.take(~late | (imu.stamp_ns > START_NS + 400_000_000))
    elif damage == "imu upside down":
        imu = dataclasses.replace(imu, gyro_rad_s=-imu.gyro_rad_s, accel_m_s2=-imu.accel_m_s2)
    elif damage == "nan rows":
        broken = imu.gyro_rad_s.copy()
        broken[::3] = np.nan
        broken[1::7] = 1e6
        imu = dataclasses.replace(imu, gyro_rad_s=broken)
    elif damage == "repeated stamps":
        imu = Imu.concatenate([imu, imu.take(slice(None, None, -1))])
    else:
        wheel = wheel.take((wheel.stamp_ns < START_NS - 10**9) | (wheel.stamp_ns > START_NS + 2 * 10**9))
    for scan, flat in zip(scans, run(scans, make_session(), imu, wheel)):
        assert np.isfinite(flat.points()).all()
        assert rms(flat.points() - exact(scan, twist)) < 0.06


def test_stray_stamps_do_not_throw_points_away() -> None:
    twist = np.array([0, 0, 0.3, 10.0, 0, 0])
    scans, _ = moving_scans(twist, 1, street(0))
    stamps = scans[0].stamp_ns.copy()
    stamps[7] += 3600 * 10**9
    (flat,) = run(
        [dataclasses.replace(scans[0], stamp_ns=stamps)],
        make_session(),
        *sensors(twist, T_base_imu=np.eye(4)),
    )
    others = np.arange(len(stamps)) != 7
    assert rms((flat.points() - exact(scans[0], twist))[others]) < 0.02
    assert np.linalg.norm(flat.points()[7] - scans[0].points()[7]) < 10.0


def test_small_and_lonely_scans_pass() -> None:
    scans, _ = moving_scans(np.array([0, 0, 0.3, 10.0, 0, 0]), 2, street(0))
    empty = scans[0].take(slice(0, 0))
    few = scans[1].take(slice(0, 5))
    assert [len(s) for s in run([empty, few, empty], make_session())] == [0, 5, 0]
    (alone,) = run(scans[:1], make_session())
    assert alone.points().tobytes() == scans[0].points().tobytes()  # nothing tells its motion
    assert run([], make_session()) == []


def test_scans_stream_one_by_one_and_the_same_input_gives_the_same_bytes() -> None:
    scans, _ = moving_scans(np.array([0, 0, 0.3, 10.0, 0, 0]), 4, street(4))
    for scan in scans:
        for name in ("stamp_ns", "x_m", "y_m", "z_m", "intensity", "ring"):
            getattr(scan, name).flags.writeable = False
    taken = 0

    def feed() -> Iterator[Scan]:
        nonlocal taken
        for scan in scans:
            taken += 1
            yield scan

    stream = iter(deskew(SETTINGS, Scans(feed()), make_session(), Imu.empty(), Wheel.empty()))
    assert taken == 0
    first = [next(stream)]
    assert taken == 2
    first += [*stream]
    again = run(scans, make_session())
    assert [s.points().tobytes() for s in first] == [s.points().tobytes() for s in again]
    assert [s.scan_index for s in first] == [0, 1, 2, 3]


@pytest.mark.parametrize("wheel_noise", [0.0, 0.02])
def test_track_bias_standstill_and_relative_motion(wheel_noise: float) -> None:
    base = np.array([0, 0, np.radians(30), 20.0, 0, 0])
    imu, wheel = sensors(base, wheel_noise=wheel_noise)
    track = MotionTrack.build(imu, wheel, make_session(mounted=True))
    assert track.has_rotation
    assert track.has_translation
    assert 1e-7 < np.abs(track.gyro_bias_rad_s - BIAS).max() < 5e-4
    ((start, end),) = track.standstill
    assert 4.5e9 < end - start < 5.5e9
    T = track.relative(START_NS, START_NS + 10**9)
    truth = inverse(T_BASE_LIDAR) @ se3_exp(base) @ T_BASE_LIDAR
    assert 1e-5 < np.linalg.norm((T - truth)[:3, 3]) < 0.05  # gyro noise over 20 m
    assert np.abs((T - truth)[:3, :3]).max() < 2e-3
    np.testing.assert_allclose(track.relative(START_NS + 10**9, START_NS), inverse(T), atol=1e-9)
    cover = track.covers(START_NS, START_NS + 10**9)
    assert cover.rotation
    assert cover.translation
    assert not track.covers(START_NS + 10**9, START_NS + 10 * 10**9).rotation


def test_bias_from_a_quiet_imu_when_there_are_no_wheels() -> None:
    imu, _ = sensors(np.array([0, 0, 0.6, 5.0, 0, 0]))
    track = MotionTrack.build(imu, Wheel.empty(), make_session(mounted=True))
    assert not track.has_translation
    assert 1e-7 < np.abs(track.gyro_bias_rad_s - BIAS).max() < 1e-3


def test_turn_rate_of_the_wheels_replaces_a_missing_gyro() -> None:
    twist = np.array([0, 0, np.radians(30), 10.0, 0, 0])
    scans, _ = moving_scans(twist, 1, street(0))
    _, wheel = sensors(twist)
    wheel = dataclasses.replace(wheel, yaw_rate_rad_s=np.full(len(wheel), twist[2]))
    (flat,) = run(scans, make_session(), None, wheel)
    assert rms(flat.points() - exact(scans[0], twist)) < 1e-3
