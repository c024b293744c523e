"""The solver: batch optimisation with GTSAM, robust by graduated non-convexity (Yang et al., arXiv 1909.08605).

Odometry, gravity and priors are known inliers. Loops and GNSS are doubted: the truncated least-squares cost lets each
of them weigh fully or not at all. Doubted factors that fail the chi-square test at the solution are switched off and
the graph is solved once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanloom.schemas.errors import StageError
from scanloom.stages.fusion.drives import I8
from scanloom.stages.fusion.factors import Factor, whitened_norms
from scanloom.stages.geometry.se3 import F8

EXACT_MARGINALS_UP_TO = 5000
GNC_STEP = 2.0
"""Factor by which the cost turns from convex to truncated in each round; 1.4 takes longer and finds the same."""
DEGREES_OF_FREEDOM = {"loop": 6, "gnss": 3}


@dataclass(frozen=True)
class Solution:
    """Nodes T (n, 4, 4) at the optimum; `graph` and `values` are GTSAM's, for marginals."""

    T: F8
    graph: Any
    values: Any


def solve(nodes: F8, factors: Sequence[Factor], inlier_probability: float) -> Solution:
    """Optimise nodes (n, 4, 4) from their initial values; sets weight and verdict of doubted factors that fail.

    Raises
    ------
    StageError : the graph leaves a pose undetermined.
    """
    active = [f for f in factors if not f.verdict]
    try:
        first = _solve_doubting(nodes, active, inlier_probability)
        if _switch_off(active, first.T, inlier_probability):
            active = [f for f in active if not f.verdict]
        return _solve_plain(first.T, active)
    except RuntimeError as error:
        raise StageError(
            f"the pose graph cannot be solved: {str(error).strip().splitlines()[0]}",
            next_step="look for sessions without odometry, GNSS or loops that tie them to the rest",
        ) from error


def marginals(solution: Solution) -> F8:
    """Marginal covariances (n, 6, 6), order (rotation, translation), right tangent.

    Exact up to 5000 nodes. Beyond that every m-th node is computed and the ones between are interpolated linearly,
    since the covariance changes slowly along a track.
    """
    import gtsam

    n = len(solution.T)
    found = gtsam.Marginals(solution.graph, solution.values)
    step = -(-n // EXACT_MARGINALS_UP_TO)
    picked = np.unique(np.append(np.arange(0, n, step), n - 1))
    exact = np.array([found.marginalCovariance(int(k)) for k in picked])
    if step == 1:
        return exact
    return interpolate_covariances(picked, exact, np.arange(n))


def interpolate_covariances(at: I8, covariance: F8, wanted: I8) -> F8:
    """Covariances (m, 6, 6) at `wanted` (m,) between those at increasing `at` (n,); the end value is kept outside."""
    if len(at) == 1:
        return np.repeat(covariance, len(wanted), axis=0)
    i = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, len(at) - 2)
    share = np.clip((wanted - at[i]) / np.maximum(at[i + 1] - at[i], 1), 0.0, 1.0)[:, None, None]
    return np.asarray(covariance[i] * (1 - share) + covariance[i + 1] * share)


def _solve_doubting(nodes: F8, factors: Sequence[Factor], probability: float) -> Solution:
    import gtsam

    trusted = [k for k, f in enumerate(factors) if not f.doubted]
    if len(trusted) == len(factors):
        return _solve_plain(nodes, factors)
    graph, values = _gtsam_graph(factors), _gtsam_values(nodes)
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(trusted)
    params.setLambdaStep(GNC_STEP)
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    optimizer.setInlierCostThresholdsAtProbability(probability)
    solved = optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())
    for factor, weight in zip(factors, weights, strict=True):
        factor.weight = float(weight)
        if factor.doubted and weight < 0.5:
            factor.verdict = "switched off: contradicts the rest of the graph"
    return Solution(_matrices(solved, len(nodes)), graph, solved)


def _solve_plain(nodes: F8, factors: Sequence[Factor]) -> Solution:
    import gtsam

    graph, values = _gtsam_graph(factors), _gtsam_values(nodes)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-8)
    params.setAbsoluteErrorTol(1e-8)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    return Solution(_matrices(solved, len(nodes)), graph, solved)


def _switch_off(factors: Sequence[Factor], T: F8, probability: float) -> bool:
    """Chi-square test of the doubted factors at the solution; true when one fails."""
    from scipy.special import gammaincinv

    limits = {kind: 2.0 * float(gammaincinv(n / 2.0, probability)) for kind, n in DEGREES_OF_FREEDOM.items()}
    norms = whitened_norms(factors, T)
    failed = False
    for factor, norm in zip(factors, norms, strict=True):
        if factor.doubted and not factor.verdict:
            limit = limits[factor.kind]
            if norm**2 > limit:
                factor.weight, factor.verdict = (
                    0.0,
                    f"switched off: chi-square {norm**2:.0f} above {limit:.0f}",
                )
            else:
                factor.weight = 1.0
        failed = failed or bool(factor.verdict)
    return failed


def _gtsam_graph(factors: Sequence[Factor]) -> Any:
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    for f in factors:
        graph.add(_gtsam_factor(gtsam, f))
    return graph


def _gtsam_factor(gtsam: Any, f: Factor) -> Any:
    if f.kind in ("odometry", "wheel", "loop"):
        model = gtsam.noiseModel.Gaussian.Covariance(f.covariance)
        return gtsam.BetweenFactorPose3(f.i, f.j, gtsam.Pose3(f.measurement), model)
    if f.kind in ("prior", "base"):
        model = gtsam.noiseModel.Gaussian.Covariance(f.covariance)
        return gtsam.PriorFactorPose3(f.i, gtsam.Pose3(f.measurement), model)
    if f.kind == "gnss":
        model = gtsam.noiseModel.Gaussian.Covariance(f.covariance[3:, 3:])
        return gtsam.GPSFactorArm(f.i, f.measurement[:3, 3], f.arm_m, model)
    model = gtsam.noiseModel.Gaussian.Covariance(f.covariance[:2, :2])
    up = gtsam.Unit3(f.measurement[:3, 3])
    return gtsam.AttitudeFactorPose3(f.i, gtsam.Unit3(np.array([0.0, 0.0, 1.0])), model, up)


def _gtsam_values(nodes: F8) -> Any:
    import gtsam

    values = gtsam.Values()
    for k, T in enumerate(nodes):
        values.insert(k, gtsam.Pose3(T))
    return values


def _matrices(values: Any, n: int) -> F8:
    return np.array([values.atPose3(k).matrix() for k in range(n)])
