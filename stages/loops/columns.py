"""Points as columns: cells seen from above, each with one bit for every height layer that holds something."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int

U8 = NDArray[np.uint64]

CELL_M = 0.5
"""Edge of a cell and height of a layer."""
LAYERS = 64
TOP_LEVEL = 4
HALF_CELLS = 150
CELLS = 2 * HALF_CELLS
_PAIRS, _FOURS, _EIGHTS, _SUM = (
    np.uint64(v) for v in (0x5555555555555555, 0x3333333333333333, 0x0F0F0F0F0F0F0F0F, 0x0101010101010101)
)
_0, _1, _2, _4, _56 = (np.uint64(v) for v in (0, 1, 2, 4, 56))


def columns(points: F8, low_m: float, margin: int) -> tuple[F8, U8]:
    """Middles (n, 2), m, of the cells that hold points (k, 3), and their layers (n,) over `low_m`.

    Points in the first and last `margin` layers, or farther than 75 m from the origin on an axis, are left out: bits can
    then be shifted by the margin and none is lost.
    """
    grid = np.zeros((CELLS, CELLS), np.uint64)
    _occupy(np.ascontiguousarray(points), low_m, 0, margin, grid)
    u, v = np.nonzero(grid)
    middles: F8 = (np.column_stack((u, v)).astype(np.float64) - HALF_CELLS + 0.5) * CELL_M
    return middles, grid[u, v]


def pyramid(points: F8, low_m: float) -> U8:
    """Grids (5, 300, 300, 2) of bits of layers over `low_m`: at level k, what any of 2^k cells from there on along each axis
    holds; first what holds points (n, 3), then that with all its neighbours."""
    grids = np.zeros((TOP_LEVEL + 1, CELLS, CELLS, 2), np.uint64)
    # A cell before the first may still cover what lies 2^k - 1 cells on: none does when the border is empty.
    exact = np.zeros((CELLS, CELLS), np.uint64)
    _occupy(np.ascontiguousarray(points), low_m, 1 << TOP_LEVEL, 1, exact)
    grids[0, :, :, 0] = exact
    _widen(grids[0])
    for level in range(TOP_LEVEL):
        _pool(grids[level], grids[level + 1], 1 << level)
    return grids


@kernel
def _occupy(points: F8, low: float, border: Int, margin: Int, grid: U8) -> None:
    for n in range(len(points)):
        u = np.int64(np.floor(points[n, 0] / CELL_M)) + HALF_CELLS
        v = np.int64(np.floor(points[n, 1] / CELL_M)) + HALF_CELLS
        layer = np.int64(np.floor((points[n, 2] - low) / CELL_M))
        if (
            border <= u < CELLS - border
            and border <= v < CELLS - border
            and margin <= layer < LAYERS - margin
        ):
            grid[u, v] |= _1 << np.uint64(layer)


@kernel
def _widen(grid: U8) -> None:
    """Second of each pair of bits: the first of the cell and of its 26 neighbours."""
    for u in range(1, CELLS - 1):
        for v in range(1, CELLS - 1):
            bits = _0
            for i in range(u - 1, u + 2):
                for j in range(v - 1, v + 2):
                    bits |= grid[i, j, 0]
            grid[u, v, 1] = bits | (bits << _1) | (bits >> _1)


@kernel
def _pool(fine: U8, coarse: U8, step: Int) -> None:
    up = np.uint64(step)
    for u in range(CELLS):
        for v in range(CELLS):
            for k in range(2):
                bits = fine[u, v, k]
                if u + step < CELLS:
                    bits |= fine[u + step, v, k]
                    if v + step < CELLS:
                        bits |= fine[u + step, v + step, k]
                if v + step < CELLS:
                    bits |= fine[u, v + step, k]
                coarse[u, v, k] = bits | (bits >> up)


@kernel
def count(bits: np.uint64) -> Int:
    """Number of ones."""
    bits = bits - ((bits >> _1) & _PAIRS)
    bits = (bits & _FOURS) + ((bits >> _2) & _FOURS)
    bits = (bits + (bits >> _4)) & _EIGHTS
    return np.int64((bits * _SUM) >> _56)


@kernel
def score(grid: U8, cells: NDArray[np.int32], bits: U8, x: Int, y: Int, z: Int) -> Int:
    """Bits of columns at `cells` (n, 2), shifted by cells and layers, that meet those of the grid, exact and widened."""
    total, up, down = 0, np.uint64(max(z, 0)), np.uint64(max(-z, 0))
    for n in range(len(bits)):
        u, v = cells[n, 0] + x, cells[n, 1] + y
        if 0 <= u < CELLS and 0 <= v < CELLS:
            at = (bits[n] << up) >> down
            total += count(grid[u, v, 0] & at) + count(grid[u, v, 1] & at)
    return total


@kernel
def children(
    grid: U8, cells: NDArray[np.int32], bits: U8, x: Int, y: Int, z: Int, step: Int
) -> NDArray[np.int64]:
    """Scores (8,) at all corners of a cube of edge `step` from (x, y, z) on, z fastest."""
    totals = np.zeros(8, np.int64)
    low, high = np.uint64(max(z, 0)), np.uint64(max(z + step, 0))
    low_down, high_down = np.uint64(max(-z, 0)), np.uint64(max(-z - step, 0))
    for n in range(len(bits)):
        below, above = (bits[n] << low) >> low_down, (bits[n] << high) >> high_down
        for k in range(4):
            u, v = cells[n, 0] + x + (k >> 1) * step, cells[n, 1] + y + (k & 1) * step
            if 0 <= u < CELLS and 0 <= v < CELLS:
                exact, wide = grid[u, v, 0], grid[u, v, 1]
                if wide:
                    totals[2 * k] += count(exact & below) + count(wide & below)
                    totals[2 * k + 1] += count(exact & above) + count(wide & above)
    return totals
