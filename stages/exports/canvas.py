"""A raster that is painted point by point, wherever the points fall, in bounded memory.

Cells are numbered from the origin of the coordinate system, so that rasters of neighbouring maps lie on one lattice.
Their sums live in square blocks; those not touched for a while wait on disk. A point goes straight into its cell, never
into a raster of its tile first: a cell on the border of two tiles gets the points of both.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8

BLOCK = 256
"""Cells along the edge of a block."""
BLOCKS_IN_MEMORY = 96
I8 = NDArray[np.int64]
CELL = np.dtype([("count", "u4"), ("sum", "f8"), ("lowest", "f4"), ("highest", "f4")])
"""What is kept of the values in a cell: 20 bytes, 1.3 MB a block."""


class Canvas:
    """Counts, sums and extremes of values per square cell.

    Rows are numbered northwards here: row = floor(y / cell), column = floor(x / cell).
    """

    def __init__(self, folder: Path, cell_m: float, blocks_in_memory: int = BLOCKS_IN_MEMORY) -> None:
        self.folder = folder
        self.cell_m = cell_m
        self._limit = blocks_in_memory
        self._blocks: OrderedDict[tuple[int, int], NDArray[np.void]] = OrderedDict()
        self._spilled: set[tuple[int, int]] = set()
        self._low: I8 | None = None
        self._high: I8 | None = None

    @property
    def empty(self) -> bool:
        return self._low is None

    @property
    def extent(self) -> tuple[int, int, int, int]:
        """First row, first column, rows and columns of what is painted."""
        if self._low is None or self._high is None:
            return 0, 0, 0, 0
        rows, columns = self._high - self._low + 1
        return int(self._low[0]), int(self._low[1]), int(rows), int(columns)

    def cells_of(self, xy: F8) -> I8:
        """Row and column (n, 2) of points (n, 2)."""
        return np.floor(xy[:, ::-1] / self.cell_m).astype(np.int64)

    def paint(self, xy: F8, values: F8) -> None:
        """Add values (n,) at places (n, 2), metres."""
        if not len(xy):
            return
        cells = self.cells_of(xy)
        self._grow(cells)
        for key, chosen in _by_block(cells):
            block = self._block(key)
            row, column = (cells[chosen] - BLOCK * np.array(key)).T
            taken = values[chosen]
            np.add.at(block["count"], (row, column), 1)
            np.add.at(block["sum"], (row, column), taken)
            np.minimum.at(block["lowest"], (row, column), taken.astype(np.float32))
            np.maximum.at(block["highest"], (row, column), taken.astype(np.float32))

    def window(self, row: int, column: int, rows: int, columns: int) -> NDArray[np.void]:
        """Cells (rows, columns) from a first row and column on, row by row northwards; copied."""
        out = blank((rows, columns))
        for r in range(row // BLOCK, (row + rows - 1) // BLOCK + 1):
            for c in range(column // BLOCK, (column + columns - 1) // BLOCK + 1):
                if (r, c) not in self._blocks and (r, c) not in self._spilled:
                    continue
                top, left = max(row, r * BLOCK), max(column, c * BLOCK)
                bottom, right = min(row + rows, (r + 1) * BLOCK), min(column + columns, (c + 1) * BLOCK)
                part = self._block((r, c))[
                    top - r * BLOCK : bottom - r * BLOCK, left - c * BLOCK : right - c * BLOCK
                ]
                out[top - row : bottom - row, left - column : right - column] = part
        return out

    def highest_at(self, cells: I8) -> NDArray[np.float32]:
        """The highest value (n,) of each cell (n, 2); minus infinity where there is none."""
        found = np.full(len(cells), -np.inf, np.float32)
        for key, chosen in _by_block(cells):
            row, column = (cells[chosen] - BLOCK * np.array(key)).T
            found[chosen] = self._block(key)["highest"][row, column]
        return found

    def _grow(self, cells: I8) -> None:
        low, high = cells.min(axis=0), cells.max(axis=0)
        self._low = low if self._low is None else np.minimum(self._low, low)
        self._high = high if self._high is None else np.maximum(self._high, high)

    def _block(self, key: tuple[int, int]) -> NDArray[np.void]:
        """The block, made, or fetched back from disk; the one not used for the longest time makes room."""
        if key in self._blocks:
            self._blocks.move_to_end(key)
            return self._blocks[key]
        while len(self._blocks) >= self._limit:
            old, block = self._blocks.popitem(last=False)
            np.save(self._file(old), block)
            self._spilled.add(old)
        self._blocks[key] = np.load(self._file(key)) if key in self._spilled else blank((BLOCK, BLOCK))
        return self._blocks[key]

    def _file(self, key: tuple[int, int]) -> Path:
        return self.folder / f"block_{key[0]}_{key[1]}.npy"


def blank(shape: tuple[int, int]) -> NDArray[np.void]:
    """Cells that hold nothing."""
    cells = np.zeros(shape, CELL)
    cells["lowest"], cells["highest"] = np.inf, -np.inf
    return cells


def _by_block(cells: I8) -> Iterator[tuple[tuple[int, int], I8]]:
    """Each block that cells (n, 2) lie in, and which of them do, in their order."""
    keys, which = np.unique(cells // BLOCK, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    ends = np.cumsum(np.bincount(which.ravel(), minlength=len(keys)))
    for key, chosen in zip(keys, np.split(order, ends[:-1]), strict=True):
        yield (int(key[0]), int(key[1])), chosen
