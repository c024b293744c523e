"""Poses between poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_exp, so3_log


def interpolate_poses(stamp_ns: NDArray[np.int64], T: F8, at_ns: NDArray[np.int64]) -> F8:
    """Poses (m, 4, 4) at the times `at_ns` (m,) from poses T (n, 4, 4) at increasing times `stamp_ns` (n,).

    Translation is linear, rotation follows the geodesic (slerp). Outside the range the end pose is kept.
    """
    if len(stamp_ns) == 1:
        return np.repeat(T, len(at_ns), axis=0)
    at = np.clip(at_ns, stamp_ns[0], stamp_ns[-1])
    i = np.clip(np.searchsorted(stamp_ns, at, side="right") - 1, 0, len(stamp_ns) - 2)
    span = (stamp_ns[i + 1] - stamp_ns[i]).astype(float)
    share = (at - stamp_ns[i]) / np.maximum(span, 1.0)
    t = T[i, :3, 3] * (1 - share)[:, None] + T[i + 1, :3, 3] * share[:, None]
    delta = so3_log((inverse(T[i]) @ T[i + 1])[:, :3, :3])
    return pose(T[i, :3, :3] @ so3_exp(delta * share[:, None]), t)


def inside(stamp_ns: NDArray[np.int64], at_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of the times `at_ns` lie within the range of `stamp_ns`."""
    if len(stamp_ns) == 0:
        return np.zeros(len(at_ns), bool)
    within: NDArray[np.bool_] = (at_ns >= stamp_ns[0]) & (at_ns <= stamp_ns[-1])
    return within
