"""Slips are found and filled in the whole log, nothing else is touched; the scale is the median of what was well seen."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.traction import (
    GRAVITY_M_S2,
    SLIP_M_S,
    Traction,
    WheelScale,
    follows,
    robust_line,
    without_slips,
)

START_NS = 1_700_000_000_000_000_000
SECONDS = 60.0
SESSION = Session(
    name="drive", format="mcap", start_ns=START_NS, end_ns=START_NS + 60 * 10**9, scan_count=600, point_count=1,
    scan_rate_hz=10.0, beams=32, point_time="per point", topics=(), extrinsics=(), problems=(), complete=True,
)  # fmt: skip


def speed(t: np.ndarray) -> np.ndarray:
    """Three seconds of standing, then faster and slower."""
    return np.clip(t - 3, 0, 8) * 1.2 + 2.0 * np.sin(np.clip(t - 11, 0, None) / 4)


def slope(t: np.ndarray) -> np.ndarray:
    """Nose up, rad: hills of 4 %."""
    return 0.04 * np.sin(np.clip(t - 3, 0, None) / 3)


def drive(
    bump_m_s: float = 0.0, at_s: float = 30.0, seed: int = 2
) -> tuple[Wheel, Imu, np.ndarray, np.ndarray]:
    """Wheel and IMU of a drive over hills with a slip; the true speed at the wheel's stamps, and the slip."""
    rng = np.random.default_rng(seed)
    t, w = np.arange(0, SECONDS, 0.01), np.arange(0, SECONDS, 0.02)
    ahead = np.gradient(speed(t), t) + GRAVITY_M_S2 * np.sin(slope(t)) + 0.05
    accel = np.column_stack((ahead, 0 * t, GRAVITY_M_S2 * np.cos(slope(t)))) + 0.03 * rng.standard_normal(
        (len(t), 3)
    )
    gyro = np.column_stack((0 * t, -np.gradient(slope(t), t), 0 * t)) + 0.002 * rng.standard_normal(
        (len(t), 3)
    )
    slip = bump_m_s * np.exp(-0.5 * ((w - at_s) / 0.5) ** 2)
    noise = np.where(speed(w) > 0.05, 0.02, 0.0) * rng.standard_normal(len(w))
    wheel = Wheel(START_NS + (w * 1e9).astype(np.int64), speed(w) + slip + noise, np.full(len(w), np.nan))
    return wheel, Imu(START_NS + (t * 1e9).astype(np.int64), gyro, accel), speed(w), slip


@pytest.mark.parametrize("bump_m_s", [3.0, -2.0])
def test_a_slip_is_filled_and_the_rest_stays_to_the_bit(bump_m_s: float) -> None:
    wheel, imu, true, slip = drive(bump_m_s)
    found = without_slips(wheel, imu, SESSION)
    changed = found.wheel.speed_m_s != wheel.speed_m_s
    assert (changed == np.isin(wheel.stamp_ns, found.slip_ns)).all()
    assert changed[np.abs(slip) > 0.4].all()
    assert not changed[np.abs(slip) < 1e-3].any()
    assert 0.005 < np.abs(found.wheel.speed_m_s - true)[changed].max() < 0.25
    way = 0.02 * (found.wheel.speed_m_s - true).sum()
    assert abs(0.02 * (wheel.speed_m_s - true).sum()) > 2.0
    assert abs(way) < 0.3
    assert found.wheel.stamp_ns is wheel.stamp_ns


@pytest.mark.parametrize("share, slips", [(0.6, False), (1.6, True)])
def test_small_bumps_are_no_slips(share: float, slips: bool) -> None:
    wheel, imu, _, _ = drive(share * SLIP_M_S)
    assert bool(len(without_slips(wheel, imu, SESSION).slip_ns)) == slips


def test_a_drive_without_slips_is_left_alone() -> None:
    wheel, imu, _, _ = drive()
    found = without_slips(wheel, imu, SESSION)
    assert len(found.slip_ns) == 0
    assert found.wheel.speed_m_s.tobytes() == wheel.speed_m_s.tobytes()


def test_what_has_no_end_is_no_slip() -> None:
    wheel, imu, _, _ = drive(3.0, at_s=SECONDS)
    assert len(without_slips(wheel, imu, SESSION).slip_ns) == 0


def test_an_accelerometer_that_tells_nothing_is_not_asked() -> None:
    wheel, imu, _, _ = drive(3.0)
    still = dataclasses.replace(imu, accel_m_s2=np.tile([0.0, 0.0, GRAVITY_M_S2], (len(imu.stamp_ns), 1)))
    none = dataclasses.replace(imu, accel_m_s2=np.full((len(imu.stamp_ns), 3), np.nan))
    backwards = dataclasses.replace(imu, accel_m_s2=imu.accel_m_s2 * [-1, 1, 1])
    for other in (still, none, backwards, Imu.empty()):
        assert without_slips(wheel, other, SESSION).wheel is wheel


def test_wheels_that_always_slip_are_not_judged() -> None:
    wheel, imu, _, _ = drive()
    t = 1e-9 * (wheel.stamp_ns - START_NS)
    wild = dataclasses.replace(wheel, speed_m_s=wheel.speed_m_s + 2.0 * (np.mod(t, 4.0) < 1.9) * (t > 11))
    assert without_slips(wild, imu, SESSION).wheel is wild


def test_the_accelerometer_must_agree_within_a_third() -> None:
    at_ns = START_NS + np.arange(3000) * 20_000_000
    gained = 5 * np.sin(np.arange(3000) / 100)
    assert follows(at_ns, 1.29 * gained, gained)
    assert not follows(at_ns, 1.31 * gained, gained)
    assert follows(at_ns, 0.71 * gained, gained)
    assert not follows(at_ns, 0.69 * gained, gained)
    assert not follows(at_ns, gained, 0.01 * gained)


def test_a_line_passes_under_bumps() -> None:
    at_ns = START_NS + np.arange(3000) * 20_000_000
    t = np.arange(3000) * 0.02
    line = 1.0 + 0.1 * t
    bumps = 5.0 * ((np.mod(t, 8.0) > 1.0) & (np.mod(t, 8.0) < 4.0))
    assert np.abs(robust_line(at_ns, line + bumps) - line).max() < 0.05
    assert np.abs(robust_line(at_ns[:300], line[:300]) - 1.3).max() < 0.01  # too short for a line: a level


def test_slips_are_known_by_time() -> None:
    slipped = Traction(Wheel.empty(), np.array([100, 110], np.int64)).slipped
    assert slipped(90, 101) and slipped(110, 120) and slipped(100, 101)
    assert not slipped(90, 100) and not slipped(111, 200)


def test_scale_is_the_median_by_way() -> None:
    scale = WheelScale()
    assert scale.value == 1.0
    rng = np.random.default_rng(1)
    for k in range(400):
        wheel_m = 1.0
        slip = 0.05 if k % 3 == 0 else 0.0
        scale.learn(wheel_m, wheel_m * (0.99 + slip) + 0.003 * rng.standard_normal())
    assert scale.value == pytest.approx(0.9915, abs=0.0015)


def test_scale_is_cautious_at_first_and_forgets() -> None:
    scale = WheelScale()
    for _ in range(5):
        scale.learn(1.0, 0.98)
    assert 0.99 < scale.value < 1.0
    for _ in range(600):
        scale.learn(1.0, 0.98)
    assert scale.value == pytest.approx(0.98, abs=0.0006)
    for _ in range(600):
        scale.learn(1.0, 1.02)
    assert scale.value == pytest.approx(1.02, abs=0.0006)
    scale.learn(1.0, 1.3)
    assert scale.value == pytest.approx(1.02, abs=0.0006)
