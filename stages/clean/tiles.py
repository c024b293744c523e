"""Which bricks a tile needs: its own, and those one voxel beyond its border, so that it can be decided alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.voxels import INDEX_BITS, INDEX_MASK, INDEX_OFFSET

I8 = NDArray[np.int64]


def brick_indices(bricks: I8) -> I8:
    """Indices (n, 3) of bricks by their keys."""
    i, j = bricks >> (2 * INDEX_BITS), (bricks >> INDEX_BITS) & INDEX_MASK
    return np.column_stack((i & INDEX_MASK, j, bricks & INDEX_MASK)) - INDEX_OFFSET


def bricks_by_tile(
    bricks: I8, brick_m: float, tile_m: float, border_m: float
) -> Iterator[tuple[str, NDArray[np.intp]]]:
    """Name of each tile, with the rows of the bricks that reach into it or its border, ordered by key.

    A brick at a border goes to both sides.
    """
    low = brick_indices(bricks)[:, :2] * brick_m
    first = np.floor((low - border_m) / tile_m).astype(np.int64)
    last = np.ceil((low + brick_m + border_m) / tile_m).astype(np.int64) - 1
    names, rows = [], []
    most = int((last - first).max(initial=0)) + 1
    for a in range(most):
        for b in range(most):
            tile = first + np.array([a, b])
            there = np.flatnonzero((tile <= last).all(axis=1))
            names.append(tile[there])
            rows.append(there)
    tile, row = np.concatenate(names), np.concatenate(rows)
    order = np.lexsort((bricks[row], tile[:, 1], tile[:, 0]))
    tile, row = tile[order], row[order]
    starts = np.flatnonzero(np.any(np.diff(tile, axis=0, prepend=tile[:1] - 1) != 0, axis=1))
    for start, end in zip(starts, [*starts[1:], len(tile)]):
        yield f"{tile[start, 0]}_{tile[start, 1]}", row[start:end]
