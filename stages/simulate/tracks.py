"""IMU and wheel speed as a vehicle's sensors give them: noisy, biased, slipping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.settings import Settings

IMU_HZ, WHEEL_HZ = 100, 50
GRAVITY_M_S2 = 9.8066


@dataclass(frozen=True)
class ImuTrack:
    t: F8
    """True times (n,) s."""
    stamp_ns: NDArray[np.int64]
    gyro_rad_s: F8
    accel_m_s2: F8


@dataclass(frozen=True)
class WheelTrack:
    t: F8
    stamp_ns: NDArray[np.int64]
    speed_m_s: F8
    yaw_rate_rad_s: F8
    """From the difference of the rear wheels."""


def times(settings: Settings, rate_hz: int) -> F8:
    return np.arange(int(settings.duration_s * rate_hz)) / rate_hz


def stamps(settings: Settings, t: F8, rng: np.random.Generator, late_s: float = 0.0) -> NDArray[np.int64]:
    """Header stamps: the true time, late by a constant, with a jitter that never changes the order."""
    jitter = np.clip(settings.stamp_jitter_s * rng.standard_normal(len(t)), -0.002, 0.002)
    return settings.start_s * 1_000_000_000 + np.round((t + jitter + late_s) * 1e9).astype(np.int64)


def imu_track(settings: Settings, motion: Motion) -> ImuTrack:
    """Angular rate and specific force at the IMU, in its own frame, with white noise and wandering bias.

    Specific force at lever arm l: R^T (a + g) + dw x l + w x (w x l).
    """
    rng = np.random.default_rng((settings.seed, 31))
    t = times(settings, IMU_HZ)
    rate, change = motion.body_rates(t)
    lever, R_base_imu = T_BASE["imu"][:3, 3], T_BASE["imu"][:3, :3]
    R = motion.poses(t)[:, :3, :3]
    force = np.einsum("nji,nj->ni", R, motion.acceleration(t) + np.array([0, 0, GRAVITY_M_S2]))
    force = force + np.cross(change, lever) + np.cross(rate, np.cross(rate, lever))
    step = 1 / np.sqrt(IMU_HZ)

    def wander(start: float, growth: float) -> F8:
        first = start * rng.standard_normal(3)
        out: F8 = first + np.cumsum(growth * step * rng.standard_normal((len(t), 3)), axis=0)
        return out

    gyro = rate @ R_base_imu + wander(settings.gyro_bias_rad_s, settings.gyro_walk_rad_s)
    accel = force @ R_base_imu + wander(settings.accel_bias_m_s2, settings.accel_walk_m_s2)
    gyro = gyro + settings.gyro_noise_rad_s * rng.standard_normal(gyro.shape)
    accel = accel + settings.accel_noise_m_s2 * rng.standard_normal(accel.shape)
    return ImuTrack(t, stamps(settings, t, rng, settings.imu_clock_s), gyro, accel)


def wheel_track(settings: Settings, motion: Motion) -> WheelTrack:
    """Forward speed with a scale error, noise, and slips of about a second now and then."""
    rng = np.random.default_rng((settings.seed, 32))
    t = times(settings, WHEEL_HZ)
    true = motion.velocity(t)[:, 0]
    slip = np.zeros(len(t))
    for _ in range(1 + int(settings.duration_s / 25)):
        centre, width = rng.uniform(0, settings.duration_s), rng.uniform(0.3, 0.7)
        slip += settings.wheel_slip * rng.choice([1.0, -0.6]) * np.exp(-0.5 * ((t - centre) / width) ** 2)
    moving = np.abs(true) > 0.05
    speed = true * (
        1 + settings.wheel_scale + slip
    ) + moving * settings.wheel_noise_m_s * rng.standard_normal(len(t))
    turn = motion.body_rates(t)[0][:, 2] * (1 + 2 * settings.wheel_scale) + 0.02 * rng.standard_normal(len(t))
    stamp_ns = stamps(settings, t, rng, settings.wheel_clock_s)
    return WheelTrack(t, stamp_ns, np.round(speed, 3) * moving, np.round(turn, 4) * moving)
