"""Things in one scan: returns that hang together in the image of directions, decided as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.clean.incidence import COLUMN_BITS, COLUMNS, LAST_COLUMN, ROWS
from scanloom.stages.geometry.forest import join, root
from scanloom.stages.geometry.kernels import kernel

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

BESIDE, ABOVE = 2, 4
"""Cells to the right, and upwards, in which the next return is looked for."""


@kernel
def clusters(away: F4, usable: B1, cell: I4, apart_m: float) -> I4:
    """Number (n,) of the first return of each return's cluster; returns that are not usable are alone.

    away (n,): ranges, m. Neighbours in the image belong together when their ranges differ by less than `apart_m`, half as
    much again upwards, where beams are farther apart.
    """
    parent, used = np.empty(len(away), np.int32), np.empty(len(away) + 1, np.int32)
    count = 0
    for n in range(len(away)):
        parent[n], used[count] = n, n
        count += int(usable[n] & (cell[n] >= 0))
    image, filled = np.full((ROWS, COLUMNS), -1, np.int32), np.empty(count, np.int32)
    flat, cells = image.reshape(-1), 0
    for m in range(count):
        n = used[m]
        other = flat[cell[n]]
        if other < 0:
            filled[cells] = cell[n]
            cells += 1
        elif parent[other] != parent[n] and abs(away[other] - away[n]) < apart_m:
            join(parent, other, n)
        if other < 0 or away[n] < away[other]:
            flat[cell[n]] = n
    for m in range(cells):
        row, column = filled[m] >> COLUMN_BITS, filled[m] & LAST_COLUMN
        _join_beside(parent, away, image, row, column, apart_m)
        _join_above(parent, away, image, row, column, 1.5 * apart_m)
    for m in range(count):
        parent[used[m]] = root(parent, used[m])
    return parent


@kernel
def _join_beside(parent: I4, away: F4, image: I4, row: int, column: int, apart_m: float) -> None:
    n = image[row, column]
    for step in range(1, BESIDE + 1):
        other = image[row, (column + step) & LAST_COLUMN]
        if other >= 0 and parent[other] != parent[n] and abs(away[other] - away[n]) < apart_m:
            join(parent, other, n)


@kernel
def _join_above(parent: I4, away: F4, image: I4, row: int, column: int, apart_m: float) -> None:
    n = image[row, column]
    for step in range(1, min(ABOVE, ROWS - 1 - row) + 1):
        other = image[row + step, column]
        if other >= 0:
            if parent[other] != parent[n] and abs(away[other] - away[n]) < apart_m:
                join(parent, other, n)
            return
