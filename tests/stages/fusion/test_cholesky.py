"""The block solver against dense linear algebra, and against GTSAM on a graph of poses."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from scanloom.stages.fusion import cholesky
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.system import System
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, so3_exp


def graph(n: int = 30, seed: int = 0) -> tuple[np.ndarray, list[Factor]]:
    """A ring driven twice, with loops between the laps, a fix and an up direction."""
    rng = np.random.default_rng(seed)
    angle = np.arange(n) * 4 * np.pi / n
    T = pose(so3_exp(np.column_stack((0 * angle, 0.1 * np.sin(angle), angle))), np.column_stack((10 * np.cos(angle), 10 * np.sin(angle), 0 * angle)))  # fmt: skip
    sigma = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    pairs = [(k, k + 1) for k in range(n - 1)] + [(k, k + n // 2) for k in range(0, n // 2, 4)]
    factors = [
        Factor("odometry" if b == a + 1 else "loop", a, b, inverse(T[a]) @ T[b] @ se3_exp(rng.normal(size=6) * sigma), np.diag(sigma**2))
        for a, b in pairs
    ]  # fmt: skip
    factors.append(Factor("prior", 0, -1, T[0], np.diag(sigma**2)))
    factors.append(Factor("gnss", n - 1, -1, pose(np.eye(3), T[-1, :3, 3] + 0.3), np.eye(6) * 0.04, arm_m=np.array([1.0, 0.2, 0.5])))  # fmt: skip
    return T, factors


def test_step_and_inverse_blocks_are_those_of_the_dense_matrix() -> None:
    T, factors = graph()
    system = System(len(T), factors)
    residual, A_i, A_j = system.stack.linearised(T)
    A = np.zeros((6 * len(factors), 6 * len(T)))
    for k, f in enumerate(factors):
        A[6 * k : 6 * k + 6, 6 * f.i : 6 * f.i + 6] += A_i[k]
        if f.j >= 0:
            A[6 * k : 6 * k + 6, 6 * f.j : 6 * f.j + 6] += A_j[k]
    weight = np.ones(len(factors))
    p, s = system.pattern, system.stack
    matrix, right = cholesky.assembled(p, s.i, s.j, system.between, A_i, A_j, residual, weight)
    step = cholesky.solved(p, cholesky.factorised(p, matrix), right)
    np.testing.assert_allclose(step.ravel(), np.linalg.solve(A.T @ A, -A.T @ residual.ravel()), atol=1e-9)
    dense = np.linalg.inv(A.T @ A).reshape(len(T), 6, len(T), 6)
    found = system.covariances(T, weight)
    for k in range(len(T)):
        np.testing.assert_allclose(found.poses[k], dense[k, :, k], atol=1e-9)
    for k, f in enumerate(factors):
        if f.j >= 0:
            np.testing.assert_allclose(found.across[k], dense[f.i, :, f.j], atol=1e-9)


def test_jacobians_are_those_of_finite_differences() -> None:
    T, factors = graph()
    rng = np.random.default_rng(1)
    factors.append(Factor("gravity", 3, -1, pose(np.eye(3), [0.1, 0.2, 0.97]), np.eye(6) * 1e-3))
    T = T @ se3_exp(rng.normal(size=(len(T), 6)) * 0.05)
    stack = System(len(T), factors).stack
    _, A_i, A_j = stack.linearised(T)
    for axis in range(6):
        step = np.eye(6)[axis] * 1e-6
        for k, f in enumerate(factors):
            for node, A in ((f.i, A_i), (f.j, A_j)):
                if node >= 0:
                    up, down = T.copy(), T.copy()
                    up[node], down[node] = T[node] @ se3_exp(step), T[node] @ se3_exp(-step)
                    slope = (
                        stack.taken(np.array([k])).residuals(up) - stack.taken(np.array([k])).residuals(down)
                    )[0] / 2e-6
                    np.testing.assert_allclose(
                        A[k, :, axis], slope, atol=2e-4 * max(1.0, np.abs(slope).max())
                    )


def test_optimum_and_marginals_are_gtsams() -> None:
    T, factors = graph()
    system, weight = System(len(T), factors), np.ones(len(factors))
    ours = system.optimised(T, weight)
    covariance = system.covariances(ours, weight).poses
    theirs, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for f in factors:
        model = gtsam.noiseModel.Gaussian.Covariance(f.covariance)
        if f.kind == "prior":
            theirs.add(gtsam.PriorFactorPose3(f.i, gtsam.Pose3(f.measurement), model))
        elif f.kind == "gnss":
            model = gtsam.noiseModel.Gaussian.Covariance(f.covariance[3:, 3:])
            theirs.add(gtsam.GPSFactorArm(f.i, f.measurement[:3, 3], f.arm_m, model))
        else:
            theirs.add(gtsam.BetweenFactorPose3(f.i, f.j, gtsam.Pose3(f.measurement), model))
    for k, at in enumerate(T):
        values.insert(k, gtsam.Pose3(at))
    solved = gtsam.LevenbergMarquardtOptimizer(theirs, values).optimize()
    marginals = gtsam.Marginals(theirs, solved)
    assert 2 * theirs.error(solved) == pytest.approx(float(system.squares(ours).sum()), rel=1e-4)
    for k in range(len(T)):
        np.testing.assert_allclose(ours[k], solved.atPose3(k).matrix(), atol=2e-3)
        np.testing.assert_allclose(covariance[k], marginals.marginalCovariance(k), rtol=0.05, atol=2e-5)


def test_a_pose_that_nothing_holds_is_an_error() -> None:
    p = cholesky.pattern(2, np.array([0]), np.array([1]))
    empty = cholesky.Blocks(np.zeros((2, 6, 6)), np.zeros((len(p.row), 6, 6)))
    with pytest.raises(FloatingPointError):
        cholesky.factorised(p, empty)
