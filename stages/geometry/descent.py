"""Gauss-Newton steps of a registration while every point keeps its partner."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.residuals import linearise_planes, linearise_points
from scanloom.stages.geometry.se3 import F8, _exp, _inverse, _log
from scanloom.stages.geometry.voxels import Float, Int

LEAST_PIVOT = 1e-11


class Sums(NamedTuple):
    """Over the residuals of matched points; inliers are those nearer than the scale of the robust kernel."""

    matches: int = 0
    weight: float = 0.0
    weighted_square: float = 0.0
    inliers: int = 0
    inlier_square: float = 0.0

    @property
    def sigma2(self) -> float:
        freedom = self.weight - 6
        return self.weighted_square / freedom if freedom > 0 else float("inf")


@kernel
def linearise(
    points: F8, point_normal: F8, T: F8, scale2: Float, mean: F8, normal: F8, shape: F8, H: F8, b: F8, error: F8,
    weight: F8,
) -> tuple[int, float, float, int, float]:  # fmt: skip
    """H (6, 6) and b (6,) at pose T, errors and weights (n,), and the `Sums`; plane to plane where `point_normal` has rows."""
    H[:] = 0.0
    b[:] = 0.0
    if len(point_normal) > 0:
        return linearise_planes(points, point_normal, T, scale2, mean, normal, shape, H, b, error, weight)
    return linearise_points(points, T, scale2, mean, normal, shape, H, b, error, weight)


@kernel
def descend(
    points: F8, point_normal: F8, T: F8, scale2: Float, mean: F8, normal: F8, shape: F8, error: F8, weight: F8,
    basis: F8, known: F8, expected: F8, steps: Int, least_matches: Int, small_rad: Float, small_m: Float,
) -> tuple[F8, int]:  # fmt: skip
    """The pose after at most `steps` Gauss-Newton steps from T (4, 4), fewer when one is small; and the number of matches.

    basis : (6, k) directions of the tangent in which the pose may move.
    known, expected : (6, 6) information on the pose and (4, 4) where it says the pose is; zeros when nothing is known.
    """
    H, b = np.zeros((6, 6)), np.zeros(6)
    prior = np.abs(known).max() > 0.0
    matches = 0
    for _ in range(steps):
        matches, total, square, _, _ = linearise(
            points, point_normal, T, scale2, mean, normal, shape, H, b, error, weight
        )
        if matches < least_matches:
            break
        if prior and total > 6.0:
            # In units of the residuals' variance, so that both count by what they are worth.
            sigma2 = square / (total - 6.0)
            off = _log(_product(_inverse(expected), T))
            for r in range(6):
                for c in range(6):
                    H[r, c] += sigma2 * known[r, c]
                    b[r] += sigma2 * known[r, c] * off[c]
        step = _step(H, b, basis)
        T = _product(T, _exp(step))
        turn2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
        way2 = step[3] * step[3] + step[4] * step[4] + step[5] * step[5]
        if turn2 < small_rad * small_rad and way2 < small_m * small_m:
            break
    return T, matches


@kernel
def _product(A: F8, B: F8) -> F8:
    """A B; numba's own operator would load scipy."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@kernel
def _step(H: F8, b: F8, basis: F8) -> F8:
    """Step (6,) to the least of 0.5 x H x + b x among the directions of the basis (6, k)."""
    k = basis.shape[1]
    HB = _product(H, basis)
    A, down = np.zeros((k, k)), np.zeros(k)
    for i in range(k):
        for r in range(6):
            down[i] -= basis[r, i] * b[r]
            for j in range(k):
                A[i, j] += basis[r, i] * HB[r, j]
    x, step = solve(A, down), np.zeros(6)
    for r in range(6):
        for i in range(k):
            step[r] += basis[r, i] * x[i]
    return step


@kernel
def solve(A: F8, b: F8) -> F8:
    """x (k,) with A x = b for a symmetric A that is nowhere negative; zero along rows that the others already tell (Cholesky)."""
    k = len(b)
    L, x = np.zeros((k, k)), np.zeros(k)
    scale = np.ones(k)
    for i in range(k):
        if A[i, i] > 0.0:
            scale[i] = 1.0 / np.sqrt(A[i, i])
    for i in range(k):
        for j in range(i + 1):
            rest = A[i, j] * scale[i] * scale[j]
            for m in range(j):
                rest -= L[i, m] * L[j, m]
            if i == j:
                L[i, i] = np.sqrt(rest) if rest > LEAST_PIVOT else 0.0
            elif L[j, j] > 0.0:
                L[i, j] = rest / L[j, j]
    for i in range(k):
        rest = b[i] * scale[i]
        for m in range(i):
            rest -= L[i, m] * x[m]
        x[i] = rest / L[i, i] if L[i, i] > 0.0 else 0.0
    for i in range(k - 1, -1, -1):
        rest = x[i]
        for m in range(i + 1, k):
            rest -= L[m, i] * x[m]
        x[i] = rest / L[i, i] if L[i, i] > 0.0 else 0.0
    return x * scale
