"""The octree of COPC over a map: which node each point belongs to, so that no node hangs below an empty one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tiles import TileIndex, levels_of

F8 = NDArray[np.float64]
I8 = NDArray[np.int64]
Key = tuple[int, int, int, int]
"""Depth, x, y, z of a node; depth 0 is the root."""

CELLS = 128
"""A node is so many cells of its level wide."""


@dataclass(frozen=True)
class Octree:
    """Nodes of level k are cubes of 128 cells of the map's level k, in the export's axes; the root takes all coarser levels.

    Lengths are in whole steps of the file (millimetres), so that a point and the borders of its node are rounded alike.
    """

    corner: I8
    """Lowest corner (3,) of the root, steps."""
    leaf_steps: float
    """Edge of a node of level 0."""
    top: int
    """Level of the root."""
    block_level: int
    """Level of the nodes that are about as wide as a tile: of the blocks in which points come."""

    @classmethod
    def over(cls, index: TileIndex, low: I8, high: I8, step_m: float) -> Octree:
        """The smallest that holds all points, given the corners of a box around them in steps."""
        deepest = levels_of(index.tile_size_m, index.voxel_size_m)
        leaf = CELLS * index.tile_size_m / 2.0**deepest / step_m
        extent = float((high - low).max()) + 1.0
        top = max(int(np.ceil(np.log2(extent / leaf))), 0)
        block = max(round(np.log2(index.tile_size_m / step_m / leaf)), 0)
        return cls(np.asarray(low, np.int64), leaf, max(top, block), block)

    def edge(self, level: int) -> float:
        """Of a node, steps."""
        return self.leaf_steps * 2.0**level

    def cells(self, places: I8, level: int) -> I8:
        """Node (n, 3) of each point (n, 3) at a level, counted from the root's corner."""
        return np.floor((places - self.corner) / self.edge(level)).astype(np.int64)

    def key(self, level: int, cell: tuple[int, int, int]) -> Key:
        return self.top - level, *cell

    def levels(self, places: I8, level: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Levels of the points (n,) of a whole block, some raised so that above every node with points there are points.

        From the top down: where a node would have points below but none of its own, the first of the coarsest below is
        raised into it. Nodes larger than the block are treated as if they held no other, which raises a point too many at most.
        """
        out = np.minimum(level, self.top).astype(np.uint8)
        leaves, leaf_of = _distinct(self.cells(places, 0))
        many = self.top + 1
        counts = np.bincount(leaf_of * many + out, minlength=len(leaves) * many).reshape(-1, many)
        for at in range(self.top, 0, -1):
            _, node_of = _distinct(leaves >> at)
            own = np.bincount(node_of, counts[:, at])
            below = np.bincount(node_of, counts[:, :at].sum(axis=1))
            for node in np.flatnonzero((own == 0) & (below > 0)):
                inside = np.flatnonzero(node_of == node)
                coarsest = int(np.flatnonzero(counts[inside].sum(axis=0)[:at])[-1])
                leaf = inside[np.flatnonzero(counts[inside, coarsest])[0]]
                row = np.flatnonzero((leaf_of == leaf) & (out == coarsest))[0]
                out[row] = at
                counts[leaf, coarsest] -= 1
                counts[leaf, at] += 1
        return out


def _distinct(cells: I8) -> tuple[I8, I8]:
    """The different cells (m, 3), and the number among them of each (n,)."""
    low = cells.min(axis=0)
    sides = cells.max(axis=0) - low + 1
    flat = np.ravel_multi_index(tuple((cells - low).T), tuple(sides))
    counted = np.bincount(flat)
    numbers = np.cumsum(counted > 0) - 1
    found = np.column_stack(np.unravel_index(np.flatnonzero(counted), tuple(sides))).astype(np.int64)
    return found + low, numbers[flat]
