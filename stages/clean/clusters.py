"""Things in one scan: returns that hang together in the image of directions, decided as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.clean.incidence import COLUMNS, ROWS
from scanloom.stages.geometry.forest import join, root
from scanloom.stages.geometry.kernels import kernel

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

BESIDE, ABOVE = 2, 4
"""Cells to the right, and upwards, in which the next return is looked for."""


@kernel
def clusters(x: F4, y: F4, z: F4, usable: B1, cell: I4, apart_m: float) -> I4:
    """Number (n,) of the first return of each return's cluster; returns that are not usable are alone.

    Neighbours in the image belong together when their ranges differ by less than `apart_m`, half as much again upwards,
    where beams are farther apart.
    """
    parent = np.arange(len(x)).astype(np.int32)
    image = np.full((ROWS, COLUMNS), -1, np.int32)
    flat = image.reshape(-1)
    ranges = np.sqrt(x * x + y * y + z * z)
    for n in range(len(x)):
        if not usable[n] or cell[n] < 0:
            continue
        other = flat[cell[n]]
        if other >= 0 and abs(ranges[other] - ranges[n]) < apart_m:
            join(parent, other, n)
        if other < 0 or ranges[n] < ranges[other]:
            flat[cell[n]] = n
    for row in range(ROWS):
        for column in range(COLUMNS):
            if image[row, column] >= 0:
                _join_beside(parent, ranges, image, row, column, apart_m)
                _join_above(parent, ranges, image, row, column, 1.5 * apart_m)
    for n in range(len(x)):
        parent[n] = root(parent, n)
    return parent


@kernel
def _join_beside(parent: I4, ranges: F4, image: I4, row: int, column: int, apart_m: float) -> None:
    n = image[row, column]
    for step in range(1, BESIDE + 1):
        other = image[row, (column + step) % COLUMNS]
        if other >= 0 and abs(ranges[other] - ranges[n]) < apart_m:
            join(parent, other, n)


@kernel
def _join_above(parent: I4, ranges: F4, image: I4, row: int, column: int, apart_m: float) -> None:
    n = image[row, column]
    for step in range(1, min(ABOVE, ROWS - 1 - row) + 1):
        other = image[row + step, column]
        if other >= 0:
            if abs(ranges[other] - ranges[n]) < apart_m:
                join(parent, other, n)
            return
