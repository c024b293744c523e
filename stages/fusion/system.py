"""The graph as a system of equations: optimum by Levenberg-Marquardt, covariances at it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.stages.fusion import cholesky
from scanloom.stages.fusion.factors import BETWEEN, Factor
from scanloom.stages.fusion.linearization import I8, moved, stacked
from scanloom.stages.geometry.se3 import F8, adjoint, inverse, se3_log

LOOSE = 1e-8
"""Information added to every pose where parts of the graph may float: a standard deviation of 10 km."""
UNMEASURED = 1e6
"""Variance that stands for a direction not measured, rad^2 and m^2."""


@dataclass(frozen=True)
class Covariances:
    """Of poses (n, 6, 6), and between the two ends (m, 6, 6) of each factor on two poses; right tangents."""

    poses: F8
    across: F8

    def motions(self, rows: I8, i: I8, j: I8, T: F8) -> F8:
        """Of the motions T_i^-1 T_j of the factors `rows`, tangent at j: xi_j - Ad(T_j^-1 T_i) xi_i."""
        A = adjoint(inverse(T[j]) @ T[i])
        cross = A @ self.across[rows]
        out = self.poses[j] + A @ self.poses[i] @ np.swapaxes(A, 1, 2) - cross - np.swapaxes(cross, 1, 2)
        return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


class System:
    """Factors of one graph with n poses; every factor has a weight that is handed in, 0 for one out of use."""

    def __init__(self, n: int, factors: Sequence[Factor]) -> None:
        self.stated = stacked(factors)
        self.stack = self.stated
        self.covariance_stated = np.array([f.covariance for f in factors], float).reshape(-1, 6, 6)
        self.scale = np.ones((len(factors), 2))
        two = np.flatnonzero(self.stack.shape == BETWEEN)
        self.pattern = cholesky.pattern(n, self.stack.i[two], self.stack.j[two])
        self.between = np.zeros(len(factors), np.int64)
        self.between[two] = self.pattern.positions(self.stack.i[two], self.stack.j[two])

    def rescale(self, scale: F8) -> None:
        """Standard deviations of rotation and translation (m, 2) over the stated ones."""
        self.scale = scale
        self.stack = self.stated.scaled(scale)

    def covariance_of(self, rows: I8, halves: tuple[float, float] | None = None) -> F8:
        """Covariances (m, 6, 6), finite, as scaled, or with rotation and translation times `halves` of what is stated."""
        C = self.covariance_stated[rows]
        variance = np.diagonal(C, axis1=1, axis2=2)
        open_ = np.isinf(variance)
        C = np.where(open_[:, :, None] | open_[:, None, :], 0.0, C)
        C[:, np.arange(6), np.arange(6)] = np.where(open_, UNMEASURED, variance)
        by = np.repeat(self.scale[rows] if halves is None else np.tile(halves, (len(rows), 1)), 3, axis=1)
        return np.asarray(C * by[:, :, None] * by[:, None, :])

    def errors(self, rows: I8, T: F8) -> F8:
        """Residuals (m, 6) of factors on two poses before whitening."""
        s = self.stack
        return se3_log(inverse(s.measurement[rows]) @ inverse(T[s.i[rows]]) @ T[s.j[rows]])

    def squares(self, T: F8) -> F8:
        """Chi-square (m,) of every factor."""
        return np.asarray((self.stack.residuals(T) ** 2).sum(axis=1))

    def optimised(
        self, T: F8, weight: F8, *, loose: bool = False, iterations: int = 50, tolerance: float = 1e-8
    ) -> F8:
        """Poses (n, 4, 4) of least cost from T on.

        Raises
        ------
        FloatingPointError : a pose is left undetermined.
        """
        cost, damping = float(weight @ self.squares(T)), 0.0
        for _ in range(iterations):
            matrix, right = self._normal_equations(T, weight, loose)
            while True:
                trial = moved(T, self._step(matrix, right, damping))
                new = float(weight @ self.squares(trial))
                if new <= cost * (1 + 1e-12) + 1e-12:
                    break
                damping = max(10.0 * damping, 1e-6)
                if damping > 1e8:
                    return T
            gain, T, cost = cost - new, trial, new
            damping = damping / 10.0 if damping > 1e-6 else 0.0
            if gain <= tolerance * cost + 1e-10:
                break
        return T

    def covariances(self, T: F8, weight: F8, *, loose: bool = False) -> Covariances:
        """At poses T (n, 4, 4)."""
        p = self.pattern
        matrix, _ = self._normal_equations(T, weight, loose)
        found = cholesky.inverse_blocks(p, cholesky.factorised(p, matrix))
        s = self.stack
        across = np.zeros((len(s), 6, 6))
        two = np.flatnonzero(s.shape == BETWEEN)
        blocks = found.below[self.between[two]]
        turned = (p.place[s.i[two]] < p.place[s.j[two]])[:, None, None]
        across[two] = np.where(turned, np.swapaxes(blocks, 1, 2), blocks)
        return Covariances(found.diagonal[p.place], across)

    def _normal_equations(self, T: F8, weight: F8, loose: bool) -> tuple[cholesky.Blocks, F8]:
        residual, A_i, A_j = self.stack.linearised(T)
        s = self.stack
        matrix, right = cholesky.assembled(self.pattern, s.i, s.j, self.between, A_i, A_j, residual, weight)
        if loose:
            matrix.diagonal[:, np.arange(6), np.arange(6)] += LOOSE
        return matrix, right

    def _step(self, matrix: cholesky.Blocks, right: F8, damping: float) -> F8:
        p, diagonal = self.pattern, matrix.diagonal
        if damping:
            diagonal = diagonal.copy()
            diagonal[:, np.arange(6), np.arange(6)] *= 1.0 + damping
        return cholesky.solved(p, cholesky.factorised(p, cholesky.Blocks(diagonal, matrix.below)), right)
