"""The same drive in a graph as one writes it first: odometry and every fix, solved by GTSAM, the clock offset given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.alignment import umeyama
from scanloom.stages.geometry.interpolation import inside
from scanloom.stages.geometry.se3 import F8, inverse

METHODS = ("least_squares", "cauchy")
CLOCK_OFFSET_S = -0.6
"""The data's own description says so; it takes the antenna to be where the LiDAR is."""
ODOMETRY_SIGMA = np.repeat([np.radians(0.05), 0.03], 3)
FIX_SIGMA_M = np.array([1.0, 1.0, 2.0])


def solve(method: str, T: F8, stamp_ns: NDArray[np.int64], fix_ns: NDArray[np.int64], fix_m: F8) -> F8:
    """Poses (n, 4, 4) by a method, of odometry T (n, 4, 4) at `stamp_ns` (n,) and fixes (m, 3) at `fix_ns` (m,)."""
    import gtsam

    at = fix_ns + round(CLOCK_OFFSET_S * 1e9)
    known = np.flatnonzero(inside(stamp_ns, at))
    middle = (stamp_ns[1:] + stamp_ns[:-1]) // 2
    node = np.searchsorted(middle, at[known])
    start = umeyama(fix_m[known], T[node, :3, 3]) @ T
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    steps = gtsam.noiseModel.Diagonal.Sigmas(ODOMETRY_SIGMA)
    for k, pose in enumerate(start):
        values.insert(k, gtsam.Pose3(pose))
    for k, step in enumerate(inverse(T[:-1]) @ T[1:]):
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(step), steps))
    for k, position in zip(node, fix_m[known], strict=True):
        graph.add(gtsam.GPSFactor(int(k), position, _noise(gtsam, method)))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    return np.array([solved.atPose3(k).matrix() for k in range(len(T))])


def _noise(gtsam: Any, method: str) -> Any:
    model = gtsam.noiseModel.Diagonal.Sigmas(FIX_SIGMA_M)
    if method == "least_squares":
        return model
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), model)
