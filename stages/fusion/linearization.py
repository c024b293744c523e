"""All factors of a graph at once: whitened residuals and Jacobians at given poses.

Tangents are (rotation, translation) on the right: T <- T Exp(xi). Formulas: Sola, Deray, Atchuthan, arXiv 1812.01537.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.fusion.factors import COMPONENTS, SHAPE, Factor, certain
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, _exp, _log

I8 = NDArray[np.int64]


@dataclass(frozen=True)
class Stack:
    """m factors: shape (m,) 0 between, 1 prior, 2 position, 3 up; ends (m,); whitening (m, 6, 6), zero rows unmeasured."""

    shape: I8
    i: I8
    j: I8
    measurement: F8
    arm_m: F8
    whitening: F8
    freedom: I8
    """Directions measured."""

    def __len__(self) -> int:
        return len(self.i)

    def scaled(self, scale: F8) -> Stack:
        """With standard deviations times scale (m, 2) of rotation and translation."""
        by = np.repeat(1.0 / scale, 3, axis=1)
        return Stack(
            self.shape, self.i, self.j, self.measurement, self.arm_m, self.whitening * by[:, None, :], self.freedom
        )  # fmt: skip

    def taken(self, rows: I8) -> Stack:
        """Only the factors `rows`."""
        return Stack(
            self.shape[rows], self.i[rows], self.j[rows], self.measurement[rows], self.arm_m[rows], self.whitening[rows],
            self.freedom[rows],
        )  # fmt: skip

    def residuals(self, T: F8) -> F8:
        """Whitened residuals (m, 6) at poses T (n, 4, 4)."""
        out = np.zeros((len(self), 6))
        _residuals(self.shape, self.i, self.j, self.measurement, self.arm_m, self.whitening, T, out)
        return out

    def linearised(self, T: F8) -> tuple[F8, F8, F8]:
        """Whitened residuals (m, 6) and Jacobians (m, 6, 6) towards the tangents of both ends."""
        residual, A_i, A_j = np.zeros((len(self), 6)), *np.zeros((2, len(self), 6, 6))
        _linearise(
            self.shape, self.i, self.j, self.measurement, self.arm_m, self.whitening, T, residual, A_i, A_j
        )
        return residual, A_i, A_j


def stacked(factors: Sequence[Factor]) -> Stack:
    """Of factors in their order."""
    n = len(factors)
    shape = np.array([SHAPE[f.kind] for f in factors], np.int64)
    covariance = np.array([f.covariance for f in factors], float).reshape(n, 6, 6)
    whitening, freedom = np.zeros((n, 6, 6)), np.zeros(n, np.int64)
    for number, block in COMPONENTS.items():
        rows = np.flatnonzero(shape == number)
        if len(rows):
            inner, measured = certain(covariance[rows, block, block])
            whitening[rows, block, block] = np.linalg.inv(np.linalg.cholesky(inner)) * measured[:, :, None]
            freedom[rows] = measured.sum(axis=1)
    return Stack(
        shape, np.array([f.i for f in factors], np.int64), np.array([f.j for f in factors], np.int64),
        np.array([f.measurement for f in factors], float).reshape(n, 4, 4),
        np.array([f.arm_m for f in factors], float).reshape(n, 3), whitening, freedom,
    )  # fmt: skip


def moved(T: F8, step: F8) -> F8:
    """Poses T (n, 4, 4) times Exp(step (n, 6))."""
    out = np.empty_like(T)
    _move(T, step, out)
    return out


@kernel
def _move(T: F8, step: F8, out: F8) -> None:
    for k in range(len(T)):
        _compose(T[k], _exp(step[k]), out[k])
        # One step of Newton's towards the nearest rotation: errors of rounding must not add up over many steps.
        for _ in range(1):
            R = out[k, :3, :3].copy()
            for r in range(3):
                for c in range(3):
                    total = 1.5 * R[r, c]
                    for m in range(3):
                        for q in range(3):
                            total -= 0.5 * R[r, m] * R[q, m] * R[q, c]
                    out[k, r, c] = total


@kernel
def _compose(A: F8, C: F8, out: F8) -> None:
    for r in range(3):
        for c in range(4):
            total = A[r, 3] if c == 3 else 0.0
            for k in range(3):
                total += A[r, k] * C[k, c]
            out[r, c] = total
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@kernel
def _compose_inverse(A: F8, C: F8, out: F8) -> None:
    """out = A^-1 C."""
    for r in range(3):
        for c in range(4):
            total = 0.0
            for k in range(3):
                total += A[k, r] * (C[k, c] - A[k, 3] if c == 3 else C[k, c])
            out[r, c] = total
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@kernel
def _raw(shape: int, measured: F8, arm: F8, T_i: F8, T_j: F8, motion: F8, error: F8, e: F8) -> None:
    """Residual (6,) before whitening; `motion` is T_i^-1 T_j of a between factor, T_i of any other."""
    e[:] = 0.0
    if shape == 0:
        _compose_inverse(T_i, T_j, motion)
    else:
        motion[:] = T_i
    if shape <= 1:
        _compose_inverse(measured, motion, error)
        e[:] = _log(error)
    elif shape == 2:
        for r in range(3):
            e[3 + r] = T_i[r, 3] - measured[r, 3]
            for c in range(3):
                e[3 + r] += T_i[r, c] * arm[c]
    else:
        for c in range(3):
            e[0] += T_i[1, c] * measured[c, 3]
            e[1] -= T_i[0, c] * measured[c, 3]


@kernel
def _whiten(W: F8, e: F8, out: F8) -> None:
    for r in range(6):
        total = 0.0
        for c in range(6):
            total += W[r, c] * e[c]
        out[r] = total


@kernel
def _whiten_all(W: F8, J: F8, out: F8) -> None:
    for r in range(6):
        for k in range(6):
            w = W[r, k]
            for c in range(6):
                out[r, c] += w * J[k, c]


@kernel
def _residuals(
    shape: I8, i: I8, j: I8, measurement: F8, arm: F8, W: F8, T: F8, residual: F8
) -> None:  # fmt: skip
    motion, error, e = np.empty((4, 4)), np.empty((4, 4)), np.empty(6)
    for m in range(len(i)):
        _raw(shape[m], measurement[m], arm[m], T[i[m]], T[max(j[m], 0)], motion, error, e)
        _whiten(W[m], e, residual[m])


@kernel
def _linearise(
    shape: I8, i: I8, j: I8, measurement: F8, arm: F8, W: F8, T: F8, residual: F8, A_i: F8, A_j: F8
) -> None:
    motion, error, e = np.empty((4, 4)), np.empty((4, 4)), np.empty(6)
    J, J_i = np.empty((6, 6)), np.empty((6, 6))
    for m in range(len(i)):
        T_i = T[i[m]]
        _raw(shape[m], measurement[m], arm[m], T_i, T[max(j[m], 0)], motion, error, e)
        _whiten(W[m], e, residual[m])
        if shape[m] == 0:
            _right_jacobian_inverse(e, J)
            _whiten_all(W[m], J, A_j[m])
            _times_adjoint_of_inverse(J, motion, J_i)
            _whiten_all(W[m], J_i, A_i[m])
        elif shape[m] == 1:
            _right_jacobian_inverse(e, J)
            _whiten_all(W[m], J, A_i[m])
        else:
            _one_pose(shape[m], T_i, measurement[m], arm[m], J)
            _whiten_all(W[m], J, A_i[m])


@kernel
def _one_pose(shape: int, T: F8, measured: F8, arm: F8, J: F8) -> None:
    """Position of the antenna: [-R hat(a), R] in the last rows. Up: rows of -R hat(u), the second one negative."""
    J[:] = 0.0
    v = arm if shape == 2 else measured[:3, 3]
    for r in range(3):
        x = -(T[r, 1] * v[2] - T[r, 2] * v[1])
        y = -(T[r, 2] * v[0] - T[r, 0] * v[2])
        z = -(T[r, 0] * v[1] - T[r, 1] * v[0])
        if shape == 2:
            J[3 + r, 0], J[3 + r, 1], J[3 + r, 2] = x, y, z
            J[3 + r, 3], J[3 + r, 4], J[3 + r, 5] = T[r, 0], T[r, 1], T[r, 2]
        elif r == 1:
            J[0, 0], J[0, 1], J[0, 2] = x, y, z
        elif r == 0:
            J[1, 0], J[1, 1], J[1, 2] = -x, -y, -z


@kernel
def _right_jacobian_inverse(e: F8, J: F8) -> None:
    """I + ad/2 + ad^2/12 - ad^4/720, ad = [[hat(w), 0], [hat(v), hat(w)]]; exact enough for steps up to a radian."""
    ad, square = np.zeros((6, 6)), np.zeros((6, 6))
    for block in range(2):
        r = 3 * block
        for at in range(2 - block):
            d = 3 * at
            x, y, z = e[r], e[r + 1], e[r + 2]
            ad[r + d, d + 1], ad[r + d, d + 2], ad[r + d + 1, d + 2] = -z, y, -x
            ad[r + d + 1, d], ad[r + d + 2, d], ad[r + d + 2, d + 1] = z, -y, x
    for r in range(6):
        for k in range(6):
            for c in range(6):
                square[r, c] += ad[r, k] * ad[k, c]
    for r in range(6):
        for c in range(6):
            fourth = 0.0
            for k in range(6):
                fourth += square[r, k] * square[k, c]
            unit = 1.0 if r == c else 0.0
            J[r, c] = unit + 0.5 * ad[r, c] + square[r, c] / 12.0 - fourth / 720.0


@kernel
def _times_adjoint_of_inverse(J: F8, T: F8, out: F8) -> None:
    """out = -J Ad(T^-1), Ad(T^-1) = [[R^T, 0], [-R^T hat(t), R^T]]."""
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    lower = np.empty((3, 3))
    for r in range(3):
        a, b, c = T[0, r], T[1, r], T[2, r]
        lower[r, 0], lower[r, 1], lower[r, 2] = -(b * z - c * y), -(c * x - a * z), -(a * y - b * x)
    for r in range(6):
        for c in range(3):
            left, right = 0.0, 0.0
            for k in range(3):
                left += J[r, k] * T[c, k] + J[r, 3 + k] * lower[k, c]
                right += J[r, 3 + k] * T[c, k]
            out[r, c], out[r, 3 + c] = -left, -right
