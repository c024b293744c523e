"""Numerics of cycles through odometry: motions and covariances added up along a chain, misclosures of pairs of loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.fusion.linearization import _compose, _compose_inverse
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, _log

I8 = NDArray[np.int64]


@kernel
def add_up(part: I8, step: F8, spread: F8, T: F8, S: F8) -> None:
    for k in range(1, len(part)):
        if part[k] == part[k - 1]:
            _compose(T[k - 1], step[k], T[k])
            S[k] = S[k - 1]
            _add_carried(T[k], spread[k], 1.0, S[k])


@kernel
def _add_carried(T: F8, C: F8, factor: float, out: F8) -> None:
    """out += factor Ad(T) C Ad(T)^T."""
    A, AC = np.zeros((6, 6)), np.zeros((6, 6))
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for c in range(3):
        for r in range(3):
            A[r, c] = T[r, c]
            A[3 + r, 3 + c] = T[r, c]
        A[3, c] = y * T[2, c] - z * T[1, c]
        A[4, c] = z * T[0, c] - x * T[2, c]
        A[5, c] = x * T[1, c] - y * T[0, c]
    for r in range(6):
        for k in range(6):
            a = A[r, k]
            if a != 0.0:
                for c in range(6):
                    AC[r, c] += a * C[k, c]
    for r in range(6):
        for c in range(6):
            total = 0.0
            for k in range(6):
                total += AC[r, k] * A[c, k]
            out[r, c] += factor * total


@kernel
def close_cycles(
    part: I8, T: F8, S: F8, i: I8, j: I8, Z: F8, C: F8, pairs: I8, most_m: F8,
    square: F8, sigma_m: F8, sigma_rad: F8,
) -> None:  # fmt: skip
    """Misclosure Z_1^-1 (T_a^-1 T_c) Z_2 (T_d^-1 T_b) of loops a-b and c-d, all covariances carried to its end."""
    M, N, E, G = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    way, total, inverse_T = np.zeros((6, 6)), np.zeros((6, 6)), np.eye(4)
    unit = np.eye(4)
    for k in range(len(pairs)):
        p, q = pairs[k, 0], pairs[k, 1]
        a, b, c, d = i[p], j[p], i[q], j[q]
        if part[a] != part[c] or part[b] != part[d]:
            continue
        way[:] = 0.0
        _compose_inverse(T[b], unit, inverse_T)
        _add_carried(inverse_T, S[b] - S[d], 1.0 if b >= d else -1.0, way)
        if way[3, 3] + way[4, 4] + way[5, 5] > 3.0 * most_m[k] * most_m[k]:
            continue
        _compose_inverse(T[d], T[b], M)
        _compose(Z[q], M, N)
        # Odometry from a to c ends at c; N carries it on to b.
        _compose_inverse(T[c], unit, inverse_T)
        _compose_inverse(N, inverse_T, G)
        _add_carried(G, S[c] - S[a], 1.0 if c >= a else -1.0, way)
        sigma_m[k] = np.sqrt(max(0.0, max(way[3, 3], way[4, 4], way[5, 5])))
        sigma_rad[k] = np.sqrt(max(0.0, max(way[0, 0], way[1, 1], way[2, 2])))
        total[:] = way + C[p]
        _compose_inverse(M, unit, G)
        _add_carried(G, C[q], 1.0, total)
        _compose_inverse(T[a], T[c], M)
        _compose(M, N, G)
        _compose_inverse(Z[p], G, E)
        square[k] = _chi_square(total, _log(E))


@kernel
def _chi_square(C: F8, e: F8) -> float:
    """e^T C^-1 e by Cholesky; C is overwritten."""
    total = 0.0
    for c in range(6):
        for k in range(c):
            C[c, c] -= C[c, k] * C[c, k]
        if not C[c, c] > 0.0:
            return np.inf
        C[c, c] = np.sqrt(C[c, c])
        for r in range(c + 1, 6):
            for k in range(c):
                C[r, c] -= C[r, k] * C[c, k]
            C[r, c] /= C[c, c]
        value = e[c]
        for k in range(c):
            value -= C[c, k] * e[k]
        e[c] = value / C[c, c]
        total += e[c] * e[c]
    return total
