"""Poses: how far apart two of them are, and one without rounding."""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8, inverse, se3_log


def apart(T_a: F8, T_b: F8, distance_m: float, angle_rad: float) -> bool:
    """Whether two poses (4, 4) are at least this far or this much turned from each other."""
    turn = se3_log(inverse(T_a) @ T_b)[:3]
    return bool(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]) >= distance_m or np.linalg.norm(turn) >= angle_rad)


def orthonormal(T: F8) -> F8:
    """The pose (4, 4) with rounding removed from its rotation."""
    left, _, right = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = left @ right
    return out
