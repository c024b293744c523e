"""Connected things of a range image: cells next to each other whose ranges differ little."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.forest import join, root
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import Int

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

STEP_M, STEP_PER_M = 0.25, 0.01
"""Ranges of one thing differ by less from cell to cell."""


@kernel
def connected(range_m: F4) -> tuple[I4, Int]:
    """Number (rows, columns) of the thing each cell belongs to, from 0 in the order of cells, -1 for none; how many.

    range_m : (rows, columns), 0 where there is nothing; columns go round. Gaps of one cell along a row or a column are
        bridged: returns get lost.
    """
    rows, columns = range_m.shape
    parent = np.full(rows * columns, -1, np.int32)
    for v in range(rows):
        for u in range(columns):
            if range_m[v, u] > 0.0:
                here = v * columns + u
                parent[here] = here
                _join_before(range_m, parent, v, u)
    for v in range(rows):  # round the seam
        for u in range(min(2, columns)):
            for w in range(columns - 2 + u, columns):
                if range_m[v, u] > 0.0 and range_m[v, w] > 0.0 and alike(range_m[v, u], range_m[v, w]):
                    join(parent, v * columns + u, v * columns + w)
    out = np.full((rows, columns), -1, np.int32)
    numbers = np.full(rows * columns, -1, np.int32)
    found: Int = 0
    for here in range(rows * columns):
        if parent[here] < 0:
            continue
        first = root(parent, here)
        if numbers[first] < 0:
            numbers[first] = found
            found += 1
        out[here // columns, here % columns] = numbers[first]
    return out, found


@kernel
def _join_before(range_m: F4, parent: I4, v: int, u: int) -> None:
    """With the cells before it in the row and below it, over a gap only if the cell between is empty."""
    columns = range_m.shape[1]
    here, r = v * columns + u, range_m[v, u]
    for back in (1, 2):
        if u >= back and range_m[v, u - back] > 0.0:
            if alike(r, range_m[v, u - back]):
                join(parent, here, here - back)
            break
    for down in (1, 2):
        if v < down:
            break
        for w in range(max(u - 1, 0), min(u + 2, columns)):
            if range_m[v - down, w] > 0.0 and alike(r, range_m[v - down, w]):
                join(parent, here, (v - down) * columns + w)
        if range_m[v - down, u] > 0.0:
            break


@kernel
def alike(a: float, b: float) -> bool:
    """Whether two ranges, m, next to each other may be of one thing."""
    return abs(a - b) < STEP_M + STEP_PER_M * min(a, b)
