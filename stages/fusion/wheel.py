"""The vehicle's own motion as factors: way from the wheels, turn from the gyro (methods 1.8, the IMU/wheel factor).

Always there where both sensors are, weak beside a registration that saw its surroundings, and the one to decide where none
did: along a tunnel, on an open field, between two segments of odometry.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scanloom.stages.fusion.drives import I8, Drive
from scanloom.stages.fusion.settings import WheelSettings
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.se3 import F8, inverse, so3_log
from scanloom.stages.geometry.traction import Traction, WheelScale, without_slips
from scanloom.stages.geometry.unseen import SEEN_P

LEAST_STEP_M = 0.5
MOST_SCALE_ERROR = 0.1
SEEN_TURN_STD_RAD = np.radians(0.03)
"""Error of the turn between two keyframes that registration saw in every direction."""
BIAS_WALK_RAD_S = 3e-4
"""Growth of a gyro's bias in 1 s, rad/s."""
SLIP_STD_M_S = 0.5
SLIP_S = 1.5
"""How far a speed may be off where a slip was found and replaced by the accelerometer's, and for how long: errors of the steps
of a slip are one error, whose variance grows with the square of its time."""


@dataclass(frozen=True)
class Motions:
    """Motions (m, 4, 4) of the LiDAR from the keyframes `first` (m,) to the ones after them, and covariances (m, 6, 6)."""

    first: I8
    T: F8
    covariance: F8


NO_MOTIONS = Motions(np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))


class Odometer:
    """Gyro and wheels of one session: slips taken out, the wheels' scale and the gyro's wandering bias as its scans tell."""

    def __init__(self, settings: WheelSettings, drives: Sequence[Drive]) -> None:
        d = drives[0]
        self._settings = settings
        self._traction: Traction = without_slips(d.wheel, d.imu, d.session)
        track = MotionTrack.build(d.imu, self._traction.wheel, d.session)
        seen = [step for drive in drives for step in _seen_steps(track, drive)]
        scale = _scale([step for step in seen if not self._traction.slipped(step.start_ns, step.end_ns)])
        self._track = dataclasses.replace(
            track,
            speed_m_s=track.speed_m_s * scale,
            rate_base=track.rate_base + bias_at(track.gyro_ns, *_rate_errors(seen)),
        )

    def motion(self, start_ns: int, end_ns: int) -> tuple[F8, F8] | None:
        """Motion (4, 4) of the LiDAR between two times and its covariance (6, 6); None without gyro or wheels."""
        cover = self._track.covers(start_ns, end_ns)
        if not (cover.rotation and cover.translation):
            return None
        T = self._track.relative(start_ns, end_ns)
        return T, self._covariance(float(np.linalg.norm(T[:3, 3])), start_ns, end_ns)

    def keyframe_motions(self, drive: Drive) -> Motions:
        """Between neighbouring keyframes of a segment, where the sensors cover them."""
        stamps = drive.odometry.stamp_ns[drive.keyframes]
        found = [(k, self.motion(int(stamps[k]), int(stamps[k + 1]))) for k in range(len(stamps) - 1)]
        told = [(k, m) for k, m in found if m is not None]
        return Motions(
            np.array([k for k, _ in told], np.int64),
            np.array([m[0] for _, m in told]).reshape(-1, 4, 4),
            np.array([m[1] for _, m in told]).reshape(-1, 6, 6),
        )

    def _covariance(self, way_m: float, start_ns: int, end_ns: int) -> F8:
        """Random walks in way and time; standing adds what vibration does."""
        s, dt = self._settings, 1e-9 * (end_ns - start_ns)
        turn = np.radians(s.rotation_deg_sqrt_m) ** 2 * way_m + np.radians(s.rotation_deg_sqrt_s) ** 2 * dt
        along = s.translation_m_sqrt_m**2 * way_m + 0.002**2
        if self._traction.slipped(start_ns, end_ns):
            along += SLIP_STD_M_S**2 * dt * SLIP_S
        return np.diag([turn] * 3 + [along] * 3)


@dataclass(frozen=True)
class _Step:
    """Motion of the base between two keyframes as odometry saw it in every direction, and as gyro and wheels tell it."""

    start_ns: int
    end_ns: int
    seen: F8
    told: F8


def _seen_steps(track: MotionTrack, d: Drive) -> Iterator[_Step]:
    odometry, rows = d.odometry, d.keyframes
    poor = ~odometry.reliable | (odometry.direction_p < SEEN_P).any(axis=1)
    unseen = np.concatenate(([0], np.cumsum(poor)))
    B, back = d.T_base_lidar, inverse(d.T_base_lidar)
    for a, b in pairwise(rows):
        start, end = int(odometry.stamp_ns[a]), int(odometry.stamp_ns[b])
        cover = track.covers(start, end)
        if cover.rotation and cover.translation and unseen[b + 1] == unseen[a + 1]:
            seen = inverse(odometry.T_odom_lidar[a]) @ odometry.T_odom_lidar[b]
            yield _Step(start, end, B @ seen @ back, B @ track.relative(start, end) @ back)


def _scale(steps: Sequence[_Step]) -> float:
    """LiDAR metres per wheel metre along x of the base."""
    scale = WheelScale()
    for step in steps:
        lidar_m, wheel_m = float(step.seen[0, 3]), float(step.told[0, 3])
        if abs(wheel_m) > LEAST_STEP_M and abs(lidar_m / wheel_m - 1.0) < MOST_SCALE_ERROR:
            scale.learn(wheel_m, lidar_m)
    return scale.value


def _rate_errors(steps: Sequence[_Step]) -> tuple[I8, F8, F8]:
    """Middle times (n,), what the gyro's rate lacks there (n, 3) in the base frame, rad/s, and its variance (n,)."""
    if not steps:
        return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)
    seen, told = np.array([s.seen for s in steps]), np.array([s.told for s in steps])
    span = np.array([s.end_ns - s.start_ns for s in steps], np.int64)
    dt = np.maximum(span * 1e-9, 1e-3)
    middle = np.array([s.start_ns for s in steps], np.int64) + span // 2
    error = so3_log(np.swapaxes(told[:, :3, :3], 1, 2) @ seen[:, :3, :3])
    return middle, error / dt[:, None], (SEEN_TURN_STD_RAD / dt) ** 2


def bias_at(at_ns: I8, stamp_ns: I8, value: F8, variance: F8) -> F8:
    """A bias (m, 3) that wanders, at the times `at_ns`, from samples (n, 3) at increasing stamps with variances (n,).

    Random walk of BIAS_WALK per root of time, smoothed forwards and backwards (Rauch, Tung and Striebel 1965); between
    the samples linear, beyond them held. Zero where there is no sample.
    """
    if not len(stamp_ns):
        return np.zeros((len(at_ns), 3))
    mean, spread = value.copy(), variance.copy()
    growth = BIAS_WALK_RAD_S**2 * np.diff(stamp_ns) * 1e-9
    for k in range(1, len(mean)):
        expected = spread[k - 1] + growth[k - 1]
        gain = expected / (expected + variance[k])
        mean[k] = mean[k - 1] + gain * (value[k] - mean[k - 1])
        spread[k] = (1.0 - gain) * expected
    for k in range(len(mean) - 2, -1, -1):
        mean[k] += spread[k] / (spread[k] + growth[k]) * (mean[k + 1] - mean[k])
    since = stamp_ns[0]
    return np.column_stack(
        [np.interp((at_ns - since) * 1e-9, (stamp_ns - since) * 1e-9, mean[:, axis]) for axis in range(3)]
    )
