"""Graphs without false loops, whose optimal cost is proved (Rosen et al., SE-Sync, IJRR 2019, table 1).

SE-Sync's cost of an edge is kappa |R_j - R_i R|_F^2 + tau |t_j - t_i - R_i t|^2, without one half, with one precision
each for rotation and translation: tau = 3 / tr(C_t), kappa = 3 / (2 tr(C_R)). GTSAM's error is half of a chi-square;
with these isotropic covariances its double is SE-Sync's cost but for terms of fourth order in the residual angle.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import pose_graphs
from benchmarks.scores import Figure
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.solving import solve
from scanloom.stages.geometry.se3 import F8

OPTIMA = {"sphere2500": 1687.0, "parking-garage": 1.263}
"""As published, four digits."""
PROBABILITY = 0.999


def figures(path: Path) -> Iterator[Figure]:
    """Cost of our solution started from odometry, with every loop doubted."""
    graph = pose_graphs.read(path)
    start = graph.from_odometry()
    factors = [_isotropic(f) for f in graph.factors]
    prior = Factor("prior", 0, -1, start[0], np.eye(6) * 1e-6)
    started = time.monotonic()
    T = solve(start, [*factors, prior], PROBABILITY).T
    seconds = time.monotonic() - started
    found, name = cost(factors, T), path.stem.replace("-", "_")
    yield Figure(f"{name}.cost", found, "", "map", "SE-Sync's cost of this solver's poses")
    ratio = found / OPTIMA[path.stem]
    yield Figure(f"{name}.cost_over_optimum", ratio, "", "map", f"over {OPTIMA[path.stem]}, as published")
    yield Figure(f"{name}.wall_s", seconds, "s", "run", "solving")
    refused = sum(bool(f.verdict) for f in factors)
    yield Figure(f"{name}.loops_refused", refused, "", "map", f"of {len(graph.loops)}, all of them true")


def cost(factors: Sequence[Factor], T: F8) -> float:
    """SE-Sync's cost of poses T (n, 4, 4)."""
    i, j = np.array([f.i for f in factors]), np.array([f.j for f in factors])
    Z = np.array([f.measurement for f in factors])
    C = np.array([f.covariance for f in factors])
    tau = 3 / np.trace(C[:, 3:, 3:], axis1=1, axis2=2)
    kappa = 3 / (2 * np.trace(C[:, :3, :3], axis1=1, axis2=2))
    dR = T[j, :3, :3] - T[i, :3, :3] @ Z[:, :3, :3]
    dt = T[j, :3, 3] - T[i, :3, 3] - np.einsum("nij,nj->ni", T[i, :3, :3], Z[:, :3, 3])
    return float((kappa * (dR**2).sum(axis=(1, 2)) + tau * (dt**2).sum(axis=1)).sum())


def _isotropic(f: Factor) -> Factor:
    rotation, translation = np.trace(f.covariance[:3, :3]) / 3, np.trace(f.covariance[3:, 3:]) / 3
    return replace(f, covariance=np.diag(np.repeat([rotation, translation], 3)))
