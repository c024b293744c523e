"""Surfaces through map points: mean, normal and shape of a neighbourhood, for kernels."""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int

JACOBI_SWEEPS = 12
_OFF_DIAGONAL = 1e-20


@kernel
def eigen_symmetric_3(a: F8, vectors: F8) -> None:
    """Diagonalise the symmetric a (3, 3) in place by cyclic Jacobi rotations.

    Eigenvalues end on the diagonal of `a`, eigenvectors in the columns of `vectors`, smallest first.
    """
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(JACOBI_SWEEPS):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if off <= _OFF_DIAGONAL * (a[0, 0] ** 2 + a[1, 1] ** 2 + a[2, 2] ** 2):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                _rotate(a, vectors, p, q)
    for p in range(3):
        _sort(a, vectors, p % 2)


@kernel
def _rotate(a: F8, vectors: F8, p: Int, q: Int) -> None:
    if a[p, q] == 0.0:
        return
    theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
    sign = 1.0 if theta >= 0.0 else -1.0
    t = sign / (abs(theta) + np.sqrt(theta * theta + 1.0))
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    r = 3 - p - q
    apq, arp, arq = a[p, q], a[r, p], a[r, q]
    a[p, p] -= t * apq
    a[q, q] += t * apq
    a[p, q] = a[q, p] = 0.0
    a[r, p] = a[p, r] = c * arp - s * arq
    a[r, q] = a[q, r] = s * arp + c * arq
    for i in range(3):
        vp, vq = vectors[i, p], vectors[i, q]
        vectors[i, p] = c * vp - s * vq
        vectors[i, q] = s * vp + c * vq


@kernel
def _sort(a: F8, vectors: F8, p: Int) -> None:
    q = p + 1
    if a[q, q] < a[p, p]:
        a[p, p], a[q, q] = a[q, q], a[p, p]
        for i in range(3):
            vectors[i, p], vectors[i, q] = vectors[i, q], vectors[i, p]
