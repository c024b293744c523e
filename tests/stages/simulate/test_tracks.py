"""IMU and wheels err as they are meant to: not less, not more."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.se3 import F8, so3_exp, so3_log
from scanloom.stages.simulate.motion import Motion, build_motion
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.town import build_town
from scanloom.stages.simulate.tracks import GRAVITY_M_S2, imu_track, wheel_track

LAP = Settings(duration_s=150.0)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return build_motion(LAP, build_town(0, 0).path)


def _integrated(settings: Settings, motion: Motion) -> tuple[float, float]:
    """Error of heading, rad, and of place, m, after the log, from the true state at its start."""
    track = imu_track(settings, motion)
    T = (motion.poses(track.t) @ T_BASE["imu"]).copy()
    h = 1e-4
    v = (motion.poses(np.array([h]))[0] - motion.poses(np.array([-h]))[0]) @ T_BASE["imu"][:, 3] / (2 * h)
    R, p, velocity = T[0, :3, :3], T[0, :3, 3].copy(), v[:3].copy()
    step = 0.01
    for k in range(len(track.t) - 1):
        rate = (track.gyro_rad_s[k] + track.gyro_rad_s[k + 1]) / 2
        force = (track.accel_m_s2[k] + track.accel_m_s2[k + 1]) / 2
        accel: F8 = R @ so3_exp(rate * step / 2) @ force - np.array([0, 0, GRAVITY_M_S2])
        p = p + velocity * step + accel * step**2 / 2
        velocity = velocity + accel * step
        R = R @ so3_exp(rate * step)
    turn = so3_log(T[-1, :3, :3].T @ R)
    return float(np.linalg.norm(turn)), float(np.linalg.norm(p - T[-1, :3, 3]))


def test_perfect_imu_integrates_to_the_truth(motion: Motion) -> None:
    silent = Settings(
        duration_s=40.0,
        gyro_noise_rad_s=0,
        gyro_bias_rad_s=0,
        gyro_walk_rad_s=0,
        accel_noise_m_s2=0,
        accel_bias_m_s2=0,
        accel_walk_m_s2=0,
    )
    turn, place = _integrated(silent, motion)
    assert turn < 2e-3
    assert place < 1.0


def test_noisy_imu_drifts_as_its_bias_says(motion: Motion) -> None:
    turn, place = _integrated(Settings(duration_s=40.0), motion)
    assert 0.02 < turn < 1.0
    assert 2.0 < place < 1500.0


def test_wheels_measure_about_one_percent_too_much_and_slip(motion: Motion) -> None:
    track = wheel_track(LAP, motion)
    true = motion.velocity(track.t)[:, 0]
    fast = true > 3.0
    ratio = track.speed_m_s[fast] / true[fast]
    assert 1.007 < np.median(ratio) < 1.013
    assert 0.001 < np.median(np.abs(ratio - np.median(ratio))) < 0.02
    assert (np.abs(ratio - 1.01) > 0.05).mean() > 0.002
    assert (track.speed_m_s[np.abs(true) < 0.01] == 0).all()
