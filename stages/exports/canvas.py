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
ACROSS = 1 << 20
"""More blocks than ever lie beside each other."""
BLOCKS_IN_MEMORY = 96
I8 = NDArray[np.int64]
CELL = np.dtype([("count", "u4"), ("sum", "f8"), ("lowest", "f4"), ("highest", "f4")])
"""What is kept of the values in a cell: 20 bytes, 1.3 MB a block."""


class Canvas:
    """Counts, sums and extremes of values per square cell.

    Rows are numbered northwards here: row = floor(y / cell), column = floor(x / cell).
    """

    def __init__(self, folder: Path, cell: float, blocks_in_memory: int = BLOCKS_IN_MEMORY) -> None:
        self.folder = folder
        self.cell = cell
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
        """Rows and columns (2, n) of points (n, 2)."""
        return np.floor(np.ascontiguousarray(xy[:, ::-1].T) / self.cell).astype(np.int64)

    def paint(self, xy: F8, values: F8) -> None:
        """Add values (n,) at places (n, 2), metres; in their order, so that sums are the same on every machine."""
        if not len(xy):
            return
        cells = self.cells_of(xy)
        self._grow(cells)
        first = cells.min(axis=1) // BLOCK
        keys = _keys(cells, first)
        order = np.argsort(keys, kind="stable")
        keys, taken = keys[order], values[order]
        starts = _starts(keys)
        counts = np.diff(np.append(starts, len(keys)))
        sums = np.add.reduceat(taken, starts)
        lowest, highest = (f.reduceat(taken, starts).astype(np.float32) for f in (np.minimum, np.maximum))
        for block, at, run in self._runs(keys[starts], first):
            block["count"][at] += counts[run].astype(np.uint32)
            block["sum"][at] += sums[run]
            block["lowest"][at] = np.minimum(block["lowest"][at], lowest[run])
            block["highest"][at] = np.maximum(block["highest"][at], highest[run])

    def holds(self, row: int, column: int, rows: int, columns: int) -> bool:
        """Whether anything may be painted there; False is certain and costs nothing."""
        return any(True for _ in self._among(row, column, rows, columns))

    def highest_at(self, xy: F8) -> NDArray[np.float32]:
        """The highest value (n,) of the cells around places (n, 2); minus infinity where there is none."""
        found = np.full(len(xy), -np.inf, np.float32)
        if not len(xy):
            return found
        cells = self.cells_of(xy)
        first = cells.min(axis=1) // BLOCK
        keys, which = np.unique(_keys(cells, first), return_inverse=True)
        highest = np.empty(len(keys), np.float32)
        for block, at, run in self._runs(keys, first):
            highest[run] = block["highest"][at]
        return np.asarray(highest[which], np.float32)

    def window(self, row: int, column: int, rows: int, columns: int) -> NDArray[np.void]:
        """Cells (rows, columns) from a first row and column on, row by row northwards; copied."""
        out = blank((rows, columns))
        for r, c in self._among(row, column, rows, columns):
            top, left = max(row, r * BLOCK), max(column, c * BLOCK)
            bottom, right = min(row + rows, (r + 1) * BLOCK), min(column + columns, (c + 1) * BLOCK)
            part = self._block((r, c))[
                top - r * BLOCK : bottom - r * BLOCK, left - c * BLOCK : right - c * BLOCK
            ]
            out[top - row : bottom - row, left - column : right - column] = part
        return out

    def _runs(self, keys: I8, first: I8) -> Iterator[tuple[NDArray[np.void], I8, slice]]:
        """Of ascending keys: each block, flat, the cells in it, and which of the keys they are."""
        starts = _starts(keys // BLOCK**2)
        for begin, end in zip(starts, np.append(starts[1:], len(keys)), strict=True):
            row, column = divmod(int(keys[begin]) // BLOCK**2, ACROSS)
            block = self._block((int(first[0]) + row, int(first[1]) + column))
            yield block.reshape(-1), keys[begin:end] % BLOCK**2, slice(int(begin), int(end))

    def _among(self, row: int, column: int, rows: int, columns: int) -> Iterator[tuple[int, int]]:
        """Blocks that were ever touched and reach into a window."""
        for r in range(row // BLOCK, (row + rows - 1) // BLOCK + 1):
            for c in range(column // BLOCK, (column + columns - 1) // BLOCK + 1):
                if (r, c) in self._blocks or (r, c) in self._spilled:
                    yield r, c

    def _grow(self, cells: I8) -> None:
        low, high = cells.min(axis=1), cells.max(axis=1)
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


def blank(shape: tuple[int, ...]) -> NDArray[np.void]:
    """Cells that hold nothing."""
    cells = np.zeros(shape, CELL)
    cells["lowest"], cells["highest"] = np.inf, -np.inf
    return cells


def _keys(cells: I8, first: I8) -> I8:
    """One number per cell (2, n): its block, counted from a first one, then row and column in the block."""
    row, column = cells // BLOCK - first[:, None]
    inner_row, inner_column = cells % BLOCK
    return np.asarray(((row * ACROSS + column) * BLOCK + inner_row) * BLOCK + inner_column, np.int64)


def _starts(ascending: I8) -> I8:
    """Where each run of equal numbers begins."""
    return np.flatnonzero(np.diff(ascending, prepend=ascending[0] - 1))
