"""Points of a map by square blocks of the export's axes, which lie askew to the tiles; tiles are read about once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import StageError
from scanloom.stages.exports.clouds import part_boxes
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource

F8 = NDArray[np.float64]
Block = tuple[int, int]
Rows = NDArray[np.void]
Load = Callable[[str], tuple[Rows, NDArray[np.int64]]]
"""Packed rows (n,) of one part of the map, and the block (n, 2) of each."""

BUDGET_BYTES = 1 << 29
"""Of rows that are kept for blocks to come; beyond that, parts are dropped and read again."""


@dataclass(frozen=True)
class Grid:
    """Squares of the plane: block (i, j) holds x from corner + i * size up to, but not with, the next."""

    corner: F8
    """(2,) m."""
    size: float

    def blocks(self, low: F8, high: F8) -> list[Block]:
        """Those that a box may touch."""
        first = np.floor((low[:2] - self.corner) / self.size).astype(int)
        last = np.floor((high[:2] - self.corner) / self.size).astype(int)
        return [(i, j) for i in range(first[0], last[0] + 1) for j in range(first[1], last[1] + 1)]


def plan(
    source: MapSource, projector: Projector, options: Options, grid: Grid, slack: float
) -> dict[Block, list[str]]:
    """Parts of the map that may have points in each block, blocks along the Z-order curve.

    `slack` (m) covers the rounding of coordinates.
    """
    found: dict[Block, list[str]] = {}
    for name, (low, high) in part_boxes(source, options).items():
        corners = projector.corners(low, high)
        for block in grid.blocks(corners.min(axis=0) - slack, corners.max(axis=0) + slack):
            found.setdefault(block, []).append(name)
    return {block: found[block] for block in sorted(found, key=z_order)}


def z_order(block: Block) -> int:
    """Place of a block on the Z-order curve: neighbours on it are mostly neighbours in the plane."""
    half = 1 << 30
    code = 0
    for bit in range(31):
        code |= ((block[0] + half) >> bit & 1) << (2 * bit) | ((block[1] + half) >> bit & 1) << (2 * bit + 1)
    return code


class Pool:
    """Hands out the rows of each block once; what a part has for other blocks waits in memory, within a budget."""

    def __init__(
        self, parts: Mapping[Block, list[str]], load: Load, budget_bytes: int = BUDGET_BYTES
    ) -> None:
        self.parts = parts
        self._load = load
        self._budget_bytes = budget_bytes
        self._waiting: OrderedDict[str, dict[Block, Rows]] = OrderedDict()
        self._bytes = 0
        self.taken = 0
        """Rows handed out so far."""
        self._blocks_left: dict[str, int] = {}
        for names in parts.values():
            for name in names:
                self._blocks_left[name] = self._blocks_left.get(name, 0) + 1

    def take(self, block: Block) -> list[Rows]:
        """Rows of a block, part by part; ask for every block once."""
        found = []
        for name in self.parts.get(block, ()):
            rows = self._pieces(name).pop(block, None)
            if rows is not None:
                found.append(rows)
                self.taken += len(rows)
                self._bytes -= rows.nbytes
            self._blocks_left[name] -= 1
            if self._blocks_left[name] == 0:
                self._drop(name)
        return found

    def check_all_taken(self, points: int) -> None:
        """
        Raises
        ------
        StageError : fewer points were taken than the map has: some lie where the index of the map says there are none.
        """
        if self.taken != points:
            raise StageError(
                f"{points - self.taken} points of {points} lie outside the boxes that the index of tiles gives",
                next_step="the folder of the map is damaged: run `scanloom map` again",
            )

    def _pieces(self, name: str) -> dict[Block, Rows]:
        if name not in self._waiting:
            pieces = split(*self._load(name))
            self._bytes += sum(rows.nbytes for rows in pieces.values())
            self._waiting[name] = pieces
        self._waiting.move_to_end(name)
        while self._bytes > self._budget_bytes and len(self._waiting) > 1:
            self._drop(next(iter(self._waiting)))
        return self._waiting[name]

    def _drop(self, name: str) -> None:
        self._bytes -= sum(rows.nbytes for rows in self._waiting.pop(name, {}).values())


def split(rows: Rows, blocks: NDArray[np.int64]) -> dict[Block, Rows]:
    """Rows by block, in their order."""
    if len(rows) == 0:
        return {}
    low = blocks.min(axis=0)
    width = int(blocks[:, 1].max() - low[1]) + 1
    number = (blocks[:, 0] - low[0]) * width + (blocks[:, 1] - low[1])
    order = np.argsort(number, kind="stable")
    number = number[order]
    starts = np.flatnonzero(np.append(True, number[1:] != number[:-1]))
    ends = np.append(starts[1:], len(rows))
    # Pieces of their own: a view would keep all the others in memory.
    return {
        (int(low[0] + number[a] // width), int(low[1] + number[a] % width)): picked(rows, order[a:b])
        for a, b in zip(starts, ends)
    }


def picked(rows: Rows, at: NDArray[np.int64]) -> Rows:
    """`rows[at]`, which numpy would copy field by field, as whole records."""
    return rows.view(np.dtype((np.void, rows.dtype.itemsize)))[at].view(rows.dtype)


def joined(parts: list[Rows]) -> Rows:
    """Parts in sequence, as whole records."""
    whole = np.dtype((np.void, parts[0].dtype.itemsize))
    return np.concatenate([part.view(whole) for part in parts]).view(parts[0].dtype)
