"""Sensors with known faults, held against scans of an analytic street: found, corrected, and nothing else touched."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from scanloom.schemas.product import Parts
from scanloom.schemas.rig import AS_GIVEN, ImuCheck, SensorCheck, WheelCheck
from scanloom.schemas.scans import Scan, Scans
from scanloom.schemas.session import Extrinsic, Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.rig import corrected
from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_exp, so3_log
from scanloom.stages.sensors import Settings, sensors
from scanloom.stages.sensors.agreement import Readings, Seen, agree
from tests.worlds import street, sweep_along

START_NS = 1_700_000_000_000_000_000
T_BASE_IMU = pose(so3_exp([0.0, 0.0, np.pi / 2]), [0.4, -0.3, 0.5])
SCANS = 40
FEW = Settings(stretches=3)
Path = Callable[[F8], F8]


def winding(at_s: F8) -> F8:
    """Turns, nods and changes of speed, as a car's on a bad road."""
    yaw = 0.3 * np.sin(1.9 * at_s) + 0.1 * np.sin(3.7 * at_s)
    pitch, roll = 0.02 * np.sin(5.0 * at_s), 0.02 * np.sin(6.3 * at_s + 1)
    x = 6.0 * at_s + 1.5 * np.sin(1.3 * at_s)
    return pose(so3_exp(np.column_stack((roll, pitch, yaw))), np.column_stack((x, 0 * x, 0 * x)))


def straight(at_s: F8) -> F8:
    return pose(np.broadcast_to(np.eye(3), (len(at_s), 3, 3)), at_s[:, None] * np.array([7.0, 0, 0]))


def standing(at_s: F8) -> F8:
    return pose(np.broadcast_to(np.eye(3), (len(at_s), 3, 3)), np.zeros((len(at_s), 3)))


@dataclasses.dataclass(frozen=True)
class Log:
    scans: Parts[Scans]
    session: Session
    imu: Imu
    wheel: Wheel

    def check(
        self, imu: Imu | None = None, wheel: Wheel | None = None, settings: Settings = FEW
    ) -> SensorCheck:
        return sensors(settings, self.scans, self.session, imu or self.imu, wheel or self.wheel)


def record(path: Path) -> Log:
    rng = np.random.default_rng(8)
    world = street(3)
    scans: list[Scan] = [
        sweep_along(world, path, 0.1 * i, index=i, stamp_ns=START_NS + i * 100_000_000, rng=rng, noise_m=0.01, columns=360)
        for i in range(SCANS)
    ]  # fmt: skip
    extrinsic = Extrinsic(sensor="imu", T_base_sensor=tuple(map(tuple, T_BASE_IMU.tolist())), source="test")
    session = Session(
        name="test", format="mcap", start_ns=START_NS, end_ns=START_NS + 10**9, scan_count=SCANS, point_count=1,
        scan_rate_hz=10.0, beams=16, point_time="per point", topics=(), extrinsics=(extrinsic,), problems=(), complete=True,
    )  # fmt: skip
    return Log(
        Parts([((("session", "test"), ("chunk", "0000")), Scans(scans))]), session, gyro(path), wheels(path)
    )


def gyro(path: Path) -> Imu:
    """100 Hz, from a second before the scans to a second after."""
    rng = np.random.default_rng(9)
    t = np.arange(-1.0, 0.1 * SCANS + 1.0, 0.01)
    step = 1e-4
    R = path(t)[:, :3, :3]
    rate = so3_log(np.swapaxes(path(t - step)[:, :3, :3], 1, 2) @ path(t + step)[:, :3, :3]) / (2 * step)
    R_imu = T_BASE_IMU[:3, :3]
    accel = np.array([0, 0, 9.81]) @ R @ R_imu + rng.normal(0, 0.05, (len(t), 3))
    return Imu(START_NS + (t * 1e9).astype(np.int64), rate @ R_imu + rng.normal(0, 0.002, (len(t), 3)), accel)


def wheels(path: Path) -> Wheel:
    rng = np.random.default_rng(10)
    t = np.arange(-1.0, 0.1 * SCANS + 1.0, 0.02)
    step = 1e-4
    forward = (inverse(path(t - step)) @ path(t + step))[:, 0, 3] / (2 * step)
    return Wheel(
        START_NS + (t * 1e9).astype(np.int64), forward + rng.normal(0, 0.02, len(t)), np.full(len(t), np.nan)
    )


@pytest.fixture(scope="module")
def log() -> Log:
    return record(winding)


def shifted(stamp_ns: np.ndarray, by_s: float) -> np.ndarray:
    return stamp_ns + round(by_s * 1e9)


def same_gyro(a: Imu, b: Imu) -> float:
    """Largest difference of the readings, rad/s."""
    return float(np.abs(a.gyro_rad_s - b.gyro_rad_s).max())


def test_clean_sensors_stay_as_they_are(log: Log) -> None:
    check = log.check()
    assert check.imu.verdict == "agrees"
    assert check.wheel.verdict == "agrees"
    assert 0.9 < check.imu.correlation <= 1.0
    assert abs(check.imu.measured_offset_s) < 0.005
    assert 1e-4 < check.imu.measured_offset_std_s < 0.01
    imu, wheel = corrected(log.imu, log.wheel, check)
    assert imu is log.imu
    assert wheel is log.wheel


@pytest.mark.parametrize("by_s", [0.04, -0.15, 0.3])
def test_a_late_or_early_imu_is_put_right(log: Log, by_s: float) -> None:
    wrong = dataclasses.replace(log.imu, stamp_ns=shifted(log.imu.stamp_ns, by_s))
    check = log.check(imu=wrong)
    assert check.imu.verdict == "corrected"
    assert abs(check.imu.clock_offset_s - by_s) < 0.005
    assert check.imu.gyro_factor == 1.0
    assert check.imu.gyro_axes == AS_GIVEN
    imu, _ = corrected(wrong, log.wheel, check)
    assert np.abs(imu.stamp_ns - log.imu.stamp_ns).max() < 5_000_000
    assert any("late" in r if by_s > 0 else "early" in r for r in check.remarks)


def test_degrees_per_second_and_g_are_recognised(log: Log) -> None:
    wrong = dataclasses.replace(
        log.imu, gyro_rad_s=np.degrees(log.imu.gyro_rad_s), accel_m_s2=log.imu.accel_m_s2 / 9.80665
    )
    check = log.check(imu=wrong)
    assert check.imu.verdict == "corrected"
    imu, _ = corrected(wrong, log.wheel, check)
    assert same_gyro(imu, log.imu) < 1e-9
    assert np.abs(imu.accel_m_s2 - log.imu.accel_m_s2).max() < 1e-9
    assert check.imu.clock_offset_s == 0.0


AXES = {
    "rotated about x": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "upside down": np.diag([1.0, -1, -1]),
    "all three changed": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}


@pytest.mark.parametrize("name", AXES)
def test_other_axes_are_found(log: Log, name: str) -> None:
    M = AXES[name]
    wrong = dataclasses.replace(
        log.imu, gyro_rad_s=log.imu.gyro_rad_s @ M.T, accel_m_s2=log.imu.accel_m_s2 @ M.T
    )
    check = log.check(imu=wrong)
    assert check.imu.verdict == "corrected"
    imu, _ = corrected(wrong, log.wheel, check)
    # turns about the vertical; of the small roll and pitch the four ways to stand upright may be mistaken
    up = T_BASE_IMU[:3, :3][2]
    assert np.abs((imu.gyro_rad_s - log.imu.gyro_rad_s) @ up).max() < 1e-9
    assert np.abs((imu.accel_m_s2 - log.imu.accel_m_s2) @ up).max() < 1e-9


def test_turn_rates_of_the_wrong_sign_are_turned_round(log: Log) -> None:
    wrong = dataclasses.replace(log.imu, gyro_rad_s=-log.imu.gyro_rad_s)
    check = log.check(imu=wrong)
    assert check.imu.verdict == "corrected"
    assert check.imu.accel_axes == AS_GIVEN
    imu, _ = corrected(wrong, log.wheel, check)
    assert np.abs((imu.gyro_rad_s - log.imu.gyro_rad_s) @ T_BASE_IMU[:3, :3][2]).max() < 1e-9


def test_a_bias_that_no_rest_tells_is_found(log: Log) -> None:
    bias = np.array([0.0, 0.0, 0.02])
    check = log.check(imu=dataclasses.replace(log.imu, gyro_rad_s=log.imu.gyro_rad_s + bias))
    assert check.imu.verdict == "corrected"
    assert 1e-5 < np.linalg.norm(np.array(check.imu.gyro_bias_rad_s) - bias) < 0.006
    assert check.imu.clock_offset_s == 0.0


UNITS = {"km/h": 3.6, "mph": 1 / 0.44704, "mm/s": 1000.0, "backwards": -1.0, "backwards in km/h": -3.6}


@pytest.mark.parametrize("name", UNITS)
def test_units_and_direction_of_the_wheels(log: Log, name: str) -> None:
    wrong = dataclasses.replace(log.wheel, speed_m_s=log.wheel.speed_m_s * UNITS[name])
    check = log.check(wheel=wrong)
    assert check.wheel.verdict == "corrected"
    assert check.wheel.scale == 1.0
    _, wheel = corrected(log.imu, wrong, check)
    assert np.abs(wheel.speed_m_s - log.wheel.speed_m_s).max() < 1e-3
    assert check.imu.verdict == "agrees"


@pytest.mark.parametrize(("scale", "by_s"), [(1.0, 0.08), (1.03, 0.0), (0.96, -0.1)])
def test_scale_and_clock_of_the_wheels(log: Log, scale: float, by_s: float) -> None:
    wrong = dataclasses.replace(
        log.wheel, stamp_ns=shifted(log.wheel.stamp_ns, by_s), speed_m_s=log.wheel.speed_m_s / scale
    )
    check = log.check(wheel=wrong)
    assert check.wheel.verdict == "corrected"
    assert abs(check.wheel.clock_offset_s - by_s) < 0.025
    assert abs(check.wheel.scale - scale) < 0.005
    assert 1e-5 < check.wheel.measured_ratio_std < 0.005


@pytest.mark.parametrize("path", [straight, standing])
def test_without_evidence_nothing_is_touched(path: Path) -> None:
    quiet = record(path)
    imu = dataclasses.replace(
        quiet.imu,
        gyro_rad_s=np.degrees(quiet.imu.gyro_rad_s),
        stamp_ns=shifted(quiet.imu.stamp_ns, 0.1),
    )
    wheel = dataclasses.replace(quiet.wheel, stamp_ns=shifted(quiet.wheel.stamp_ns, 0.1))
    check = quiet.check(imu=imu, wheel=wheel)
    assert check.imu.verdict == "unknown"
    assert check.wheel.verdict == ("agrees" if path is straight else "unknown")
    again = corrected(imu, wheel, check)
    assert again[0] is imu
    assert again[1] is wheel
    assert check.remarks


def test_readings_that_fit_in_no_way_are_left_and_reported(log: Log) -> None:
    rng = np.random.default_rng(1)
    noise = np.cumsum(rng.normal(0, 0.03, log.imu.gyro_rad_s.shape), axis=0)
    imu = dataclasses.replace(log.imu, gyro_rad_s=noise - noise.mean(axis=0))
    wheel = dataclasses.replace(log.wheel, speed_m_s=log.wheel.speed_m_s * 1.7)
    check = log.check(imu=imu, wheel=wheel)
    assert check.imu.verdict == "contradicts"
    assert check.wheel.verdict == "contradicts"
    assert len(check.remarks) == 2
    again = corrected(imu, wheel, check)
    assert again[0] is imu
    assert again[1] is wheel


def test_only_reported_when_told_so(log: Log) -> None:
    wrong = dataclasses.replace(log.imu, stamp_ns=shifted(log.imu.stamp_ns, 0.04))
    check = log.check(imu=wrong, settings=Settings(stretches=3, correct=False))
    assert check.imu.clock_offset_s == 0.0
    assert abs(check.imu.measured_offset_s - 0.04) < 0.005
    assert corrected(wrong, log.wheel, check)[0] is wrong


def test_nothing_is_read_where_there_is_nothing_to_check(log: Log) -> None:
    def unread() -> Scans:
        raise AssertionError("a scan was read")

    parts = Parts([((("chunk", "0"),), None)], load=lambda _: unread())
    empty = sensors(Settings(), parts, log.session, Imu.empty(), Wheel.empty())
    off = sensors(Settings(stretches=0), parts, log.session, log.imu, log.wheel)
    assert empty == off == SensorCheck(imu=ImuCheck(), wheel=WheelCheck())


def test_a_beat_between_the_samples_is_resolved() -> None:
    """Offsets far below the spacing of 0.1 s of the intervals, to a fraction of a millisecond."""
    t = np.arange(-2, 8, 0.01)
    for lag in (-0.0123, 0.0004, 0.0371):
        start = np.arange(0, 5, 0.1)
        fine = np.arange(0, 0.1, 0.001)
        mean = np.sin(1.7 * (start[:, None] + fine + 0.0005)).mean(axis=1)
        (found,) = agree(
            Seen(start, start + 0.1, mean[:, None]), Readings(t, np.sin(1.7 * (t - lag))[:, None]), np.ones((1, 1, 1)), 0.2
        )  # fmt: skip
        assert abs(found.lag_s - lag) < 2e-4
        assert abs(found.slope - 1) < 1e-3
