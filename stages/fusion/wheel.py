"""The vehicle's own motion as factors: way from the wheels, turn from the gyro (methods 1.8, the IMU/wheel factor).

Always there where both sensors are, weak beside a registration that saw its surroundings, and the one to decide where none
did: along a tunnel, on an open field, between two segments of odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scanloom.stages.fusion.drives import I8, Drive
from scanloom.stages.fusion.settings import WheelSettings
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.geometry.traction import Traction, WheelScale, without_slips

LEAST_STEP_M = 0.5
MOST_SCALE_ERROR = 0.1
SLIP_STD_M_S = 0.5
"""How far a speed may be off where a slip was found and replaced by the accelerometer's."""


@dataclass(frozen=True)
class Motions:
    """Motions (m, 4, 4) of the LiDAR from the keyframes `first` (m,) to the ones after them, and covariances (m, 6, 6)."""

    first: I8
    T: F8
    covariance: F8


NO_MOTIONS = Motions(np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))


class Odometer:
    """Gyro and wheels of one session, slips taken out, the wheels' scale as its scans tell."""

    def __init__(self, settings: WheelSettings, drives: Sequence[Drive]) -> None:
        d = drives[0]
        self._settings = settings
        self._traction: Traction = without_slips(d.wheel, d.imu, d.session)
        track = MotionTrack.build(d.imu, self._traction.wheel, d.session)
        scale = _scale(track, self._traction, drives)
        self._track = MotionTrack.build(d.imu, self._traction.wheel, d.session, wheel_scale=scale)

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
            along += (SLIP_STD_M_S * dt) ** 2
        return np.diag([turn] * 3 + [along] * 3)


def _scale(track: MotionTrack, traction: Traction, drives: Sequence[Drive]) -> float:
    """LiDAR metres per wheel metre: over steps between keyframes that registration saw in every direction."""
    scale = WheelScale()
    for d in drives:
        odometry, rows = d.odometry, d.keyframes
        unseen = np.concatenate(
            ([0], np.cumsum(~odometry.reliable | (odometry.direction_p < 0.5).any(axis=1)))
        )
        B = d.T_base_lidar
        for a, b in pairwise(rows):
            start, end = int(odometry.stamp_ns[a]), int(odometry.stamp_ns[b])
            covered = track.covers(start, end).translation and not traction.slipped(start, end)
            if not covered or unseen[b + 1] > unseen[a + 1]:
                continue
            lidar_m = _forward(B, inverse(odometry.T_odom_lidar[a]) @ odometry.T_odom_lidar[b])
            wheel_m = _forward(B, track.relative(start, end))
            if abs(wheel_m) > LEAST_STEP_M and abs(lidar_m / wheel_m - 1.0) < MOST_SCALE_ERROR:
                scale.learn(wheel_m, lidar_m)
    return scale.value


def _forward(T_base_lidar: F8, T: F8) -> float:
    """Displacement of the base along its x axis, m, in a motion of the LiDAR."""
    return float((T_base_lidar @ T @ inverse(T_base_lidar))[0, 3])
