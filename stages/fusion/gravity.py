"""Which way is up: gravity from the accelerometer, with the vehicle's own acceleration taken out.

Over a window from t0 to t1 the mean specific force in a frame that does not turn is mean(a) + g up, and
mean(a) = (v(t1) - v(t0)) / (t1 - t0) is known from odometry. A few seconds give tenths of a degree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.fusion.drives import I8, Drive
from scanloom.stages.geometry.interpolation import inside
from scanloom.stages.geometry.se3 import F8

GRAVITY_M_S2 = 9.81
GRAVITY_TOLERANCE_M_S2 = 0.6
HALF_WINDOW_NS = 2_000_000_000
VELOCITY_BASE_NS = 200_000_000
LONGEST_GAP_NS = 250_000_000
MOST_TILT_RAD = np.radians(40.0)


@dataclass(frozen=True)
class Gravity:
    """Up directions seen from keyframes: places in `Drive.keyframes` (m,), unit vectors (m, 3) in the LiDAR frame."""

    keyframe: I8
    up_lidar: F8
    remark: str
    """Where it comes from, or why the IMU could not be used."""
    measured: bool


def gravity(drive: Drive, spacing_m: float) -> Gravity:
    """Up at keyframes about every `spacing_m`; without a usable IMU the vehicle is taken to stand level at its start."""
    picked = _spaced_keyframes(drive, spacing_m)
    up, fine = _measured_up(drive, picked)
    if not fine.any():
        reason = "no IMU" if len(drive.imu) == 0 else "no window of the accelerometer measures gravity"
        return _assumed(drive, reason)
    keyframe, up = picked[fine], up[fine] / np.linalg.norm(up[fine], axis=1, keepdims=True)
    up_base = np.median(up @ drive.T_base_lidar[:3, :3].T, axis=0)
    tilt = float(np.arccos(np.clip(up_base[2] / np.linalg.norm(up_base), -1, 1)))
    if tilt > MOST_TILT_RAD:
        return _assumed(
            drive, f"gravity lies {np.degrees(tilt):.0f} deg off the vehicle's z axis: IMU axes are doubtful"
        )
    return Gravity(keyframe, up, "accelerometer", True)


def level(drive: Drive, seen: Gravity) -> F8:
    """Rotation (3, 3) of the frame `odom` into axes whose z points up, about the smallest angle."""
    R = drive.odometry.T_odom_lidar[drive.keyframes[seen.keyframe], :3, :3]
    up = np.einsum("nij,nj->ni", R, seen.up_lidar)[:5].mean(axis=0)
    return smallest_rotation(up / np.linalg.norm(up), np.array([0.0, 0.0, 1.0]))


def smallest_rotation(a: F8, b: F8) -> F8:
    """Rotation (3, 3) about a x b that takes the unit vector a to the unit vector b; not for opposite vectors."""
    v, c = np.cross(a, b), float(a @ b)
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + c))


def _assumed(drive: Drive, reason: str) -> Gravity:
    up = drive.T_base_lidar[:3, :3].T @ np.array([[0.0], [0.0], [1.0]])
    return Gravity(
        np.zeros(1, np.int64), up.T, f"{reason}; vehicle taken to stand level at its first scan", False
    )


def _spaced_keyframes(drive: Drive, spacing_m: float) -> I8:
    """The first keyframe of every `spacing_m` of path, and of every ten seconds of standing."""
    path = drive.travelled_m[drive.keyframes]
    _, first = np.unique(np.floor(path / spacing_m), return_index=True)
    return first.astype(np.int64)


def _measured_up(drive: Drive, picked: I8) -> tuple[F8, np.ndarray]:
    """Up (m, 3) in the LiDAR frame times g, and which of them are fit for use."""
    imu, odometry = drive.imu, drive.odometry
    known = inside(odometry.stamp_ns, imu.stamp_ns) & np.isfinite(imu.accel_m_s2).all(axis=1)
    stamp, force = imu.stamp_ns[known], imu.accel_m_s2[known]
    if len(stamp) < 5 or len(odometry) < 3:
        return np.zeros((len(picked), 3)), np.zeros(len(picked), bool)
    R_odom_imu = drive.T_odom_lidar_at(stamp)[:, :3, :3] @ drive.T_lidar_imu[:3, :3]
    force_odom = np.einsum("nij,nj->ni", R_odom_imu, force)
    dt = np.diff(stamp) * 1e-9
    speed_sum = np.vstack(
        (np.zeros(3), np.cumsum(0.5 * (force_odom[1:] + force_odom[:-1]) * dt[:, None], axis=0))
    )
    at = odometry.stamp_ns[drive.keyframes[picked]]
    first = np.searchsorted(stamp, np.maximum(at - HALF_WINDOW_NS, stamp[0] + VELOCITY_BASE_NS))
    last = (
        np.searchsorted(stamp, np.minimum(at + HALF_WINDOW_NS, stamp[-1] - VELOCITY_BASE_NS), side="right")
        - 1
    )
    first, last = np.minimum(first, len(stamp) - 1), np.clip(last, 0, len(stamp) - 1)
    span_s = (stamp[last] - stamp[first]) * 1e-9
    gained = _imu_velocity(drive, stamp[last]) - _imu_velocity(drive, stamp[first])
    with np.errstate(divide="ignore", invalid="ignore"):
        up_odom = (speed_sum[last] - speed_sum[first] - gained) / span_s[:, None]
    up_lidar = np.einsum("nij,ni->nj", odometry.T_odom_lidar[drive.keyframes[picked], :3, :3], up_odom)
    gaps = np.concatenate(([0], np.cumsum(np.diff(stamp) > LONGEST_GAP_NS)))
    fine = (span_s > 1.0) & (gaps[last] == gaps[first])
    fine &= np.abs(np.linalg.norm(up_lidar, axis=1) - GRAVITY_M_S2) < GRAVITY_TOLERANCE_M_S2
    return up_lidar, fine


def _imu_velocity(drive: Drive, stamp_ns: I8) -> F8:
    """Velocity (n, 3) of the IMU in `odom`, m/s, by central differences of odometry."""
    before, after = (drive.T_odom_lidar_at(stamp_ns + d) for d in (-VELOCITY_BASE_NS, VELOCITY_BASE_NS))
    arm = drive.T_lidar_imu[:3, 3]
    moved = (after[:, :3, :3] @ arm + after[:, :3, 3]) - (before[:, :3, :3] @ arm + before[:, :3, 3])
    return np.asarray(moved / (2 * VELOCITY_BASE_NS * 1e-9))
