"""Wheels that slip, found in the whole log: what they say of a change of speed must agree with the accelerometer.

The difference of the wheels' speed and the integral of the forward acceleration, gravity taken off by the gyro, is a slow
line: the start of the integral, the bias of the accelerometer. A slip is a bump on it of a second or two. A
robust line over some seconds to either side (repeated medians, Siegel 1982) passes under the bumps.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.motion import MotionTrack, gravity_points_up
from scanloom.stages.geometry.se3 import F8

GRAVITY_M_S2 = 9.81
BIN_S, REACH = 0.2, 20
"""The line is laid through medians of short bins, over so many of them to either side: 4 s, twice as long as slips last."""
SLIP_M_S, EDGE_M_S = 0.3, 0.1
"""Speed off by which wheels slip, and below which a slip has ended."""
LEVELLING_S = 30.0
"""Time in which the gravity carried by the gyro leans towards what the accelerometer says."""
MOST_SLIP = 0.35
"""Wheels that seem to slip for a greater share of the time are not judged: then the accelerometer is not fit for it."""
LEAST_SAMPLES = 10 * REACH
CHANGE_M_S, LEAST_CHANGES, RATIO_TOLERANCE = 0.5, 0.02, 0.3
"""Changes of speed within a second that count, the share of the time in which there must be some, and how well they must agree."""
LONGEST_GAP_S = 0.1
CHUNK = 512
PRIOR_M, PRIOR_STD, MEMORY_M = 20.0, 0.01, 500.0
LEAST_SCALE, SCALE_STEP = 0.8, 0.0005
MIDDLES: F8 = LEAST_SCALE + SCALE_STEP * (np.arange(800, dtype=np.float64) + 0.5)


class Traction(NamedTuple):
    """Wheels without slips, and the stamps (k,), increasing, ns, of the samples that were replaced."""

    wheel: Wheel
    slip_ns: NDArray[np.int64]

    def slipped(self, start_ns: int, end_ns: int) -> bool:
        """Whether the wheels slipped between two times."""
        i, j = np.searchsorted(self.slip_ns, (start_ns, end_ns))
        return bool(j > i)


def without_slips(wheel: Wheel, imu: Imu, session: Session) -> Traction:
    """Speeds (n,) of slips are replaced by the line and the accelerometer; others stay to the bit.

    Wheels are returned as they came where there is no gyro and accelerometer, or none fit for it.
    """
    as_given = Traction(wheel, np.zeros(0, np.int64))
    track = MotionTrack.build(imu, wheel, session)
    accel = imu.accel_m_s2 @ np.array(session.T_base("imu"))[:3, :3].T
    good = np.isfinite(accel).all(axis=1) & np.isin(imu.stamp_ns, track.gyro_ns)
    told = np.isfinite(wheel.speed_m_s)
    level = gravity_points_up(imu.accel_m_s2, np.array(session.T_base("imu")))
    if not level or min(good.sum(), told.sum(), len(track.gyro_ns)) < LEAST_SAMPLES:
        return as_given
    rate = track.rate_base[np.searchsorted(track.gyro_ns, imu.stamp_ns[good])]
    gained = speed_gained(imu.stamp_ns[good], rate, accel[good])
    at_ns = wheel.stamp_ns[told]
    inertial = np.interp(at_ns, imu.stamp_ns[good], gained)
    if not follows(at_ns, wheel.speed_m_s[told], inertial):
        return as_given
    off = wheel.speed_m_s[told] - inertial
    line = robust_line(at_ns, off)
    slipping = _slips(off - line) & _covered(at_ns, imu.stamp_ns[good])
    if slipping.mean() > MOST_SLIP:
        return as_given
    speed = wheel.speed_m_s.copy()
    speed[np.flatnonzero(told)[slipping]] = (inertial + line)[slipping]
    return Traction(dataclasses.replace(wheel, speed_m_s=speed), np.sort(at_ns[slipping]))


def speed_gained(stamp_ns: NDArray[np.int64], rate: F8, accel: F8) -> F8:
    """Integral (n,) of the forward acceleration since the first sample, m/s: specific force without gravity.

    rate, accel : (n, 3) in the base frame, rad/s without bias, m/s2. Pauses gain nothing.
    """
    dt = np.diff(stamp_ns, prepend=stamp_ns[:1]) * 1e-9
    dt = np.where(dt > LONGEST_GAP_S, 0.0, dt)
    return np.cumsum(dt * (accel[:, 0] - _gravity_ahead(dt, rate, accel)))


def follows(at_ns: NDArray[np.int64], speed: F8, inertial: F8) -> bool:
    """Whether the accelerometer tells the changes of speed (n,), as most of those within a second show; m/s."""
    later = np.searchsorted(at_ns, at_ns + 1_000_000_000)
    rows = np.flatnonzero(later < len(at_ns))
    gained, said = inertial[later[rows]] - inertial[rows], speed[later[rows]] - speed[rows]
    some = np.abs(gained) > CHANGE_M_S
    if some.mean() < LEAST_CHANGES:
        return False
    ratio = float(np.median(said[some] / gained[some]))
    return abs(ratio - 1.0) < RATIO_TOLERANCE


@kernel
def _gravity_ahead(dt: F8, rate: F8, accel: F8) -> F8:
    """Forward part (n,) of gravity's reaction, m/s2: u' = -w x u, leaning towards the measured force within LEVELLING_S."""
    out = np.empty(len(dt))
    u = accel[0] * (GRAVITY_M_S2 / max(np.sqrt((accel[0] ** 2).sum()), 1e-9))
    for k in range(len(dt)):
        wx, wy, wz = rate[k, 0] * dt[k], rate[k, 1] * dt[k], rate[k, 2] * dt[k]
        x = u[0] - (wy * u[2] - wz * u[1])
        y = u[1] - (wz * u[0] - wx * u[2])
        z = u[2] - (wx * u[1] - wy * u[0])
        lean = dt[k] / LEVELLING_S
        u[0], u[1], u[2] = (
            x + lean * (accel[k, 0] - x), y + lean * (accel[k, 1] - y), z + lean * (accel[k, 2] - z),
        )  # fmt: skip
        size = np.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
        for i in range(3):
            u[i] *= GRAVITY_M_S2 / max(size, 1e-9)
        out[k] = u[0]
    return out


def robust_line(stamp_ns: NDArray[np.int64], value: F8) -> F8:
    """At every time (n,) the value of a line through its surroundings, by repeated medians: half of them may be wrong."""
    seconds = (stamp_ns - stamp_ns[0]) * 1e-9
    number = (seconds / BIN_S).astype(np.int64)
    bins, first = np.unique(number, return_index=True)
    medians = np.array([np.median(part) for part in np.split(value, first[1:])])
    middles = np.array([part.mean() for part in np.split(seconds, first[1:])])
    if len(bins) <= 2 * REACH:
        return np.full(len(value), np.median(value))
    centre = np.clip(np.arange(len(bins)), REACH, len(bins) - 1 - REACH)
    around = centre[:, None] + np.arange(-REACH, REACH + 1)
    levels, slopes = np.empty(len(bins)), np.empty(len(bins))
    for at in range(0, len(bins), CHUNK):
        rows = around[at : at + CHUNK]
        t, v = middles[rows] - middles[at : at + CHUNK, None], medians[rows]
        apart = t[:, None, :] - t[:, :, None]
        each = np.where(
            apart == 0, np.nan, (v[:, None, :] - v[:, :, None]) / np.where(apart == 0, 1.0, apart)
        )
        slope = np.median(np.nanmedian(each, axis=2), axis=1)
        slopes[at : at + CHUNK] = slope
        levels[at : at + CHUNK] = np.median(v - slope[:, None] * t, axis=1)
    nearest = np.searchsorted(bins, number)
    line: F8 = levels[nearest] + slopes[nearest] * (seconds - middles[nearest])
    return line


def _slips(off: F8) -> NDArray[np.bool_]:
    """Runs in which the speed is off by more than EDGE_M_S and somewhere by more than SLIP_M_S; each must begin and end."""
    some = np.abs(off) > EDGE_M_S
    run = np.cumsum(np.diff(some, prepend=False) & some)
    worst = np.zeros(int(run[-1]) + 1)
    np.maximum.at(worst, run[some], np.abs(off[some]))
    if some[0]:
        worst[run[0]] = 0.0
    if some[-1]:
        worst[run[-1]] = 0.0
    slipping: NDArray[np.bool_] = some & (worst[run] > SLIP_M_S)
    return slipping


def _covered(at_ns: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether an IMU sample is near each time."""
    after = np.clip(np.searchsorted(stamp_ns, at_ns), 1, len(stamp_ns) - 1)
    near: NDArray[np.bool_] = (
        np.minimum(np.abs(at_ns - stamp_ns[after - 1]), np.abs(stamp_ns[after] - at_ns)) < LONGEST_GAP_S * 1e9
    )
    return near


class WheelScale:
    """LiDAR metres per wheel metre: median of the ratios of single steps, weighted by way, with a memory of some hundred metres.

    A median, for what is wrong is wrong to one side: slips that were not found, and wheels that come late while braking or
    starting. Before much was driven the scale is near 1, as PRIOR_M of way with a deviation of PRIOR_STD would tell.
    """

    def __init__(self) -> None:
        self._weight: F8 = PRIOR_M * _normal((MIDDLES - 1.0) / PRIOR_STD)
        self.value = 1.0

    def learn(self, wheel_m: float, lidar_m: float) -> None:
        """Take in a step that both have seen well."""
        at = int((lidar_m / wheel_m - LEAST_SCALE) / SCALE_STEP)
        if not 0 <= at < len(MIDDLES):
            return
        self._weight[at] += abs(wheel_m)
        way = np.cumsum(self._weight)
        half = 0.5 * way[-1]
        k = int(np.searchsorted(way, half))
        share = 1.0 - (way[k] - half) / self._weight[k]
        self.value = float(LEAST_SCALE + SCALE_STEP * (k + share))
        self._weight *= min(1.0, MEMORY_M / float(way[-1]))


def _normal(x: F8) -> F8:
    """Shares (n,) of a normal distribution."""
    density = np.exp(-0.5 * x**2)
    shares: F8 = density / density.sum()
    return shares
