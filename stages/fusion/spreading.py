"""Optimised keyframes spread to all scans of a session."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.frames import MAP, WORLD, Georeference
from scanloom.schemas.trajectory import Poses
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.fusion.solving import Solution, interpolate_covariances
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, se3_log


def poses_of(d: Drive, solution: Solution, origin: Georeference | None) -> Poses:
    """Poses of all scans: odometry from the keyframe before, plus its share of the correction up to the next one."""
    rows = d.keyframes
    keyframe = np.zeros(len(d.odometry), bool)
    keyframe[rows] = True
    return Poses(
        scan_index=d.odometry.scan_index.copy(),
        stamp_ns=d.odometry.stamp_ns.copy(),
        T_world_lidar=_spread(d, solution.T[d.nodes]),
        covariance=interpolate_covariances(
            d.odometry.stamp_ns[rows], solution.covariance[d.nodes], d.odometry.stamp_ns
        ),
        keyframe=keyframe,
        frame=WORLD if origin else MAP,
        georeference=origin.model_dump() if origin else None,
    )


def _spread(d: Drive, T_keyframes: F8) -> F8:
    """T = T_a (O_a^-1 O) Exp(s xi), with xi what the motion to the next keyframe lacks and s the share of time."""
    odom, rows = d.odometry.T_odom_lidar, d.keyframes
    every = np.arange(len(odom))
    a = np.clip(np.searchsorted(rows, every, side="right") - 1, 0, len(rows) - 1)
    T = T_keyframes[a] @ inverse(odom[rows[a]]) @ odom
    if len(rows) > 1:
        xi = se3_log(inverse(T_keyframes[:-1] @ inverse(odom[rows[:-1]]) @ odom[rows[1:]]) @ T_keyframes[1:])
        at = np.minimum(a, len(rows) - 2)
        stamp = d.odometry.stamp_ns
        span = np.maximum(stamp[rows[at + 1]] - stamp[rows[at]], 1)
        share = np.where(a == at, np.clip((stamp - stamp[rows[at]]) / span, 0.0, 1.0), 0.0)
        T = T @ se3_exp(share[:, None] * xi[at])
    T[rows] = T_keyframes
    return np.asarray(T)
