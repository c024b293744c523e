"""IMU, wheel speed and GNSS as a vehicle's sensors give them: noisy, biased, slipping, misled by houses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.geodesy import georeference, world_to_geodetic
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.sweeping import cast
from scanloom.stages.simulate.terrain import EAST_X, NORTH_Y

IMU_HZ, WHEEL_HZ, GNSS_HZ = 100, 50, 5
GRAVITY_M_S2 = 9.8066
SATELLITES = 16
LOWEST_RAD = np.radians(12.0)
SETTLING_S = 6.0
"""After the sky comes back, the receiver needs this long for a fixed solution."""


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


@dataclass(frozen=True)
class GnssTrack:
    t: F8
    stamp_ns: NDArray[np.int64]
    geodetic: F8
    """Latitude deg, longitude deg, height m (n, 3); NaN without fix."""
    variance_m2: F8
    """East, north, up (n, 3) as the receiver believes."""
    status: NDArray[np.int8]
    error_m: F8
    """What the position is really off by (n, 3); for tests, never written to the log."""


def _times(settings: Settings, rate_hz: int) -> F8:
    return np.arange(int(settings.duration_s * rate_hz)) / rate_hz


def _stamps(settings: Settings, t: F8, rng: np.random.Generator, late_s: float = 0.0) -> NDArray[np.int64]:
    """Header stamps: the true time, late by a constant, with a jitter that never changes the order."""
    jitter = np.clip(settings.stamp_jitter_s * rng.standard_normal(len(t)), -0.002, 0.002)
    return settings.start_s * 1_000_000_000 + np.round((t + jitter + late_s) * 1e9).astype(np.int64)


def imu_track(settings: Settings, motion: Motion) -> ImuTrack:
    """Angular rate and specific force at the IMU, in its own frame, with white noise and wandering bias.

    Specific force at lever arm l: R^T (a + g) + dw x l + w x (w x l).
    """
    rng = np.random.default_rng((settings.seed, 31))
    t = _times(settings, IMU_HZ)
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
    return ImuTrack(t, _stamps(settings, t, rng, settings.imu_clock_s), gyro, accel)


def wheel_track(settings: Settings, motion: Motion) -> WheelTrack:
    """Forward speed with a scale error, noise, and slips of about a second now and then."""
    rng = np.random.default_rng((settings.seed, 32))
    t = _times(settings, WHEEL_HZ)
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
    stamps = _stamps(settings, t, rng, settings.wheel_clock_s)
    return WheelTrack(t, stamps, np.round(speed, 3) * moving, np.round(turn, 4) * moving)


def gnss_track(settings: Settings, motion: Motion, scene: Any) -> GnssTrack:
    """Positions of the antenna with the receiver's own idea of their quality.

    Satellites behind houses or under the deck are lost; with few left the fix is coarse or gone. Between high houses the
    receiver takes reflections for signals: it reports a fixed solution and lies by metres, slowly changing.
    """
    rng = np.random.default_rng((settings.seed, 33))
    t = _times(settings, GNSS_HZ)
    antenna = (motion.poses(t) @ T_BASE["gnss"])[:, :3, 3]
    visible = _visible(settings, scene, antenna)
    seen = visible.sum(axis=1)
    fixed = (seen >= 8) & ~_recently(seen < 6, int(SETTLING_S * GNSS_HZ))
    none = seen < 4
    sigma = np.where(fixed, 0.012, np.where(seen >= 6, 0.5, 1.6))
    canyon = _in_canyon(antenna) & (settings.route != "estate")
    misled = _ramp(canyon, 2 * GNSS_HZ)
    slow = _correlated(rng, len(t), 30 * GNSS_HZ)
    wild = _correlated(rng, len(t), 10 * GNSS_HZ) + np.array([0.8, -0.5, 0.6])
    error = sigma[:, None] * (0.8 * slow + 0.6 * rng.standard_normal((len(t), 3))) * [1, 1, 1.8]
    error = error + settings.gnss_multipath_m * misled[:, None] * 0.6 * wild
    claims_fixed = fixed | (misled > 0.3) & ~none
    claimed = np.where(claims_fixed, 0.014, sigma)
    origin = georeference(settings.latitude_deg, settings.longitude_deg, settings.height_m)
    geodetic = world_to_geodetic(origin, antenna + error)
    geodetic[none] = np.nan
    status = np.where(none, -1, np.where(claims_fixed, 2, 0)).astype(np.int8)
    variance = (claimed[:, None] * [1.0, 1.0, 1.8]) ** 2
    return GnssTrack(t, _stamps(settings, t, rng), geodetic, variance, status, error)


def _visible(settings: Settings, scene: Any, antenna: F8) -> NDArray[np.bool_]:
    """Which satellites (n, SATELLITES) each antenna position sees past houses, trees and decks."""
    rng = np.random.default_rng((settings.seed, 34))
    up = np.arcsin(rng.uniform(np.sin(LOWEST_RAD), 1.0, SATELLITES))
    around = 2 * np.pi * (np.arange(SATELLITES) + rng.uniform(0, 1, SATELLITES)) / SATELLITES
    to_sky = np.column_stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)))
    rays = np.concatenate(
        (np.repeat(antenna, SATELLITES, axis=0), np.tile(to_sky, (len(antenna), 1))), axis=1
    ).astype(np.float32)
    free: NDArray[np.bool_] = ~np.isfinite(cast(scene, rays)["range"]).reshape(len(antenna), SATELLITES)
    return free


def _in_canyon(antenna: F8) -> NDArray[np.bool_]:
    """East Street, between its high houses."""
    x, y = antenna[:, 0], antenna[:, 1]
    return (np.abs(x - EAST_X) < 7) & (y > 12) & (y < NORTH_Y - 12)


def _ramp(inside: NDArray[np.bool_], ticks: int) -> F8:
    """0 outside, 1 inside, with soft edges."""
    box = np.ones(ticks) / ticks
    padded = np.concatenate((np.zeros(ticks), inside.astype(float), np.zeros(ticks)))
    soft: F8 = np.convolve(padded, box, mode="same")[ticks:-ticks]
    return np.minimum(soft, inside)


def _recently(flag: NDArray[np.bool_], ticks: int) -> NDArray[np.bool_]:
    """True from a raised flag on for a number of ticks."""
    reach = np.convolve(np.append(flag, False).astype(float), np.ones(ticks + 1))[: len(flag)]
    return np.asarray(reach > 0)


def _correlated(rng: np.random.Generator, count: int, ticks: int) -> F8:
    """Gauss-Markov noise (count, 3) of unit variance with a correlation time in ticks."""
    from scipy.signal import lfilter

    a = np.exp(-1.0 / ticks)
    white = np.sqrt(1 - a * a) * rng.standard_normal((count, 3))
    white[:1] /= np.sqrt(1 - a * a)
    out: F8 = lfilter([1.0], [1.0, -a], white, axis=0)
    return out
