"""What GTSAM gives on a g2o file as it comes: plain least squares, Cauchy on the loops, GNC on its defaults."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.stages.geometry.se3 import F8, pose, so3_exp

METHODS = ("least_squares", "cauchy", "gnc_tls_defaults")


def solve(method: str, path: Path, flat: bool) -> F8:
    """Poses (n, 4, 4) of a method on a g2o file whose edges from k to k + 1 are odometry, started from odometry."""
    import gtsam

    edges, _ = gtsam.readG2o(str(path), not flat)
    edges = [edges.at(k) for k in range(edges.size())]
    trusted = [f.keys()[1] == f.keys()[0] + 1 for f in edges]
    values = _from_odometry(gtsam, [f for f, known in zip(edges, trusted, strict=True) if known], flat)
    graph = gtsam.NonlinearFactorGraph()
    for f, known in zip(edges, trusted, strict=True):
        graph.add(f if known or method != "cauchy" else _cauchy(gtsam, f, flat))
    dimensions = 3 if flat else 6
    tight = gtsam.noiseModel.Isotropic.Sigma(dimensions, 1e-3)
    start = gtsam.Pose2() if flat else values.atPose3(0)
    graph.add((gtsam.PriorFactorPose2 if flat else gtsam.PriorFactorPose3)(0, start, tight))
    solved = _optimised(gtsam, method, graph, values, [*np.flatnonzero(trusted), len(edges)])
    return np.array([_matrix(solved, k, flat) for k in range(values.size())])


def _optimised(gtsam: Any, method: str, graph: Any, values: Any, trusted: list[int]) -> Any:
    if method != "gnc_tls_defaults":
        return gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setKnownInliers([int(k) for k in trusted])
    return gtsam.GncLMOptimizer(graph, values, params).optimize()


def _cauchy(gtsam: Any, f: Any, flat: bool) -> Any:
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), f.noiseModel())
    kind: Callable[..., Any] = gtsam.BetweenFactorPose2 if flat else gtsam.BetweenFactorPose3
    return kind(f.keys()[0], f.keys()[1], f.measured(), robust)


def _from_odometry(gtsam: Any, edges: list[Any], flat: bool) -> Any:
    values = gtsam.Values()
    T = gtsam.Pose2() if flat else gtsam.Pose3()
    values.insert(0, T)
    for f in edges:
        T = T.compose(f.measured())
        values.insert(f.keys()[1], T)
    return values


def _matrix(values: Any, k: int, flat: bool) -> F8:
    if not flat:
        return np.asarray(values.atPose3(k).matrix())
    T = values.atPose2(k)
    return pose(so3_exp([0.0, 0.0, T.theta()]), [T.x(), T.y(), 0.0])
