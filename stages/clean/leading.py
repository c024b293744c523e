"""Which rays lead: near the sensor rays lie so close together that one passes the same voxels as its neighbours.

Directions are taken together in cells, and these in fours, level by level. A cell is narrower than a voxel up to some range,
the wider the nearer; up to that range the ray of the cell that reaches farthest is followed, the others from there on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.clean.incidence import COLUMNS, ROW_RAD, ROWS
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import Int

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

LEVELS = 5
WIDTH_SHARE = 0.5
"""Width of a cell over that of a voxel, at most: leaders of neighbouring cells are then less than a voxel apart. Of what all
rays together see through, 0.1 % is missed."""
WIDEST = 1 << (LEVELS - 1)
"""Cells of the image along each side of one of the widest."""
NO_CELL, LAST_CELL = np.int32(-1), np.int32(ROWS * COLUMNS - 1)
CELL_RAD = max(ROW_RAD, 2.0 * np.pi / COLUMNS)


@kernel
def followed_since(cell: I4, clear_m: F4, voxel_m: float) -> F4:
    """Range (n,), m, from which each ray is followed: up to there the cell is narrow in which another one leads.

    `cell` (n,) is the ray's cell in the image of directions, `clear_m` (n,) how far it reaches.
    """
    since = np.zeros(len(cell), np.float32)
    first, rows = _rows_used(cell)
    leader = np.full((rows, COLUMNS), -1, np.int32)
    flat = leader.reshape(-1)
    reach = WIDTH_SHARE * voxel_m / CELL_RAD
    for n in range(len(cell)):
        if cell[n] >= 0:
            k = cell[n] - first * COLUMNS
            flat[k] = _farther(flat[k], n, clear_m, since, reach)
    for _ in range(1, LEVELS):
        reach *= 0.5
        leader = _merged(leader, clear_m, since, reach)
    return since


@kernel
def _rows_used(cell: I4) -> tuple[Int, Int]:
    """First row of the image, and number of rows, in which there is something; both can be halved at every level."""
    low, high = NO_CELL, NO_CELL
    for n in range(len(cell)):
        high = max(high, cell[n])
        low = max(low, LAST_CELL - cell[n] if cell[n] >= 0 else NO_CELL)
    first, last = (LAST_CELL - low) // COLUMNS // WIDEST, high // COLUMNS // WIDEST
    return (first * WIDEST, (last - first + 1) * WIDEST) if high >= 0 else (0, WIDEST)


@kernel
def _merged(leader: I4, clear_m: F4, since: F4, reach: float) -> I4:
    """Leaders of cells twice as wide."""
    wider = np.full((leader.shape[0] // 2, leader.shape[1] // 2), -1, np.int32)
    for row in range(leader.shape[0]):
        for column in range(leader.shape[1]):
            n = leader[row, column]
            if n >= 0:
                before = wider[row // 2, column // 2]
                wider[row // 2, column // 2] = _farther(before, n, clear_m, since, reach)
    return wider


@kernel
def _farther(before: int, n: int, clear_m: F4, since: F4, reach: float) -> int:
    """The ray of two that reaches farther; the other is followed from `reach` on."""
    if before < 0:
        return n
    if clear_m[n] > clear_m[before]:
        since[before] = reach
        return n
    since[n] = reach
    return before
