"""Levels of detail: which points remain when a tile is thinned further and further, and the order of its rows.

Each point gets the coarsest level at which it stands for its cell. Cells are halves of halves of the tile: sorted by Morton
code, the points of a cell are neighbours on every level, and one pass over them picks one point per cell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tiles import levels_of
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import Int

I8 = NDArray[np.int64]
F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]

BITS = 10
"""Of a coordinate within the tile in a Morton code; what is above of z counts cubes of the tile's size."""
SIDE = 1 << BITS


def ordered(x_m: F4, y_m: F4, z_m: F4, tile_size_m: float, voxel_size_m: float) -> tuple[I8, U1]:
    """Rows of the points (n,) of a tile by level, coarsest first, and Morton code; and their levels, in that order.

    Every cell of `spacing_m(level)` that has a point has exactly one of that level or above, the nearest to its middle
    that was free to choose.
    """
    code = morton_codes(x_m, y_m, z_m, tile_size_m)
    order = np.argsort(code, kind="stable")
    top = levels_of(tile_size_m, voxel_size_m)
    level = _picked(code[order], order, x_m, y_m, z_m, tile_size_m / SIDE, top)
    by_level = np.argsort(np.uint8(top) - level, kind="stable")  # of small numbers: a counting sort
    return order[by_level], level[by_level]


@kernel
def morton_codes(x: F4, y: F4, z: F4, tile_m: float) -> I8:
    """Codes (n,): bits of x, y, z in turn, x lowest, of the place in steps of tile / 1024; the cube along z on top."""
    out = np.empty(len(x), np.int64)
    for n in range(len(x)):
        i, j = _step(x[n], tile_m), _step(y[n], tile_m)
        k = np.int64(np.floor(np.float64(z[n]) * SIDE / tile_m))
        out[n] = ((k >> BITS) << (3 * BITS)) | _spread(i) | (_spread(j) << 1) | (_spread(k & (SIDE - 1)) << 2)
    return out


@kernel
def _step(value: float, tile_m: float) -> Int:
    """A coordinate may be rounded onto the tile's upper border."""
    step: Int = np.int64(np.float64(value) * SIDE / tile_m)
    return SIDE - 1 if step >= SIDE else step


@kernel
def _spread(value: Int) -> Int:
    """The ten lowest bits, two zeros between each and the next."""
    v = np.int64(value)
    v = (v | (v << 16)) & 0x030000FF
    v = (v | (v << 8)) & 0x0300F00F
    v = (v | (v << 4)) & 0x030C30C3
    return (v | (v << 2)) & 0x09249249


@kernel
def _picked(code: I8, row: I8, x: F4, y: F4, z: F4, step_m: float, top: int) -> U1:
    """Level (n,) of each of the points in the order of their codes; `row` says where their coordinates are."""
    out = np.zeros(len(code), np.uint8)
    for level in range(top, 0, -1):
        bits = level + BITS - top
        cell_m, shift = step_m * (1 << bits), 3 * bits
        first = 0
        while first < len(code):
            best, least, taken, n = first, np.inf, False, first
            cell = code[first] >> shift
            while n < len(code) and code[n] >> shift == cell:
                taken |= out[n] > 0
                off = (
                    _off_middle(x[row[n]], cell_m)
                    + _off_middle(y[row[n]], cell_m)
                    + _off_middle(z[row[n]], cell_m)
                )
                if off < least:
                    best, least = n, off
                n += 1
            if not taken:
                out[best] = level
            first = n
    return out


@kernel
def _off_middle(value: float, cell_m: float) -> float:
    """Square of the distance to the middle of the cell along one axis."""
    places = np.float64(value) / cell_m
    off: float = places - np.floor(places) - 0.5
    return off * off * cell_m * cell_m
