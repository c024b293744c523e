"""COPC 1.0: one LAZ file that is an octree as well, so that programs stream what they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.exports.blocks import Block, Grid, Pool, joined, picked, plan, split
from scanloom.stages.exports.clouds import box_of, cloud_of, points_of
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.copc_file import CopcFile
from scanloom.stages.exports.las_points import SCALE_M, Records, Rows, places_of
from scanloom.stages.exports.octree import Octree
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource

MARGIN_STEPS = 10
"""Of the root around the box of the points, for the rounding of coordinates."""


def write_copc(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`map.copc.laz`: points as in `laz`, in nodes by the map's own levels of detail.

    The plane is walked through along a Z-order curve of blocks as wide as a tile. What is finer than a block is written at
    once; coarser points wait for their node's last block. So never more than one node per level is in memory, and
    what tiles have for blocks to come (see `Pool`).
    """
    projector = Projector.of(source, options)
    records = Records.of(source, projector, options)
    octree = _octree(source, projector, options, records)
    path = folder / "map.copc.laz"
    out = CopcFile(path, projector, records, octree)
    pool = _pool(source, projector, options, records, octree)
    _Walk(octree, pool, out).run()
    pool.check_all_taken(points_of(source, options))
    out.close()
    return [path]


def _octree(source: MapSource, projector: Projector, options: Options, records: Records) -> Octree:
    low, high = np.rint((box_of(source, projector, options) - records.offset_m) / SCALE_M).astype(np.int64)
    return Octree.over(source.index, low - MARGIN_STEPS, high + MARGIN_STEPS, SCALE_M)


def _pool(
    source: MapSource, projector: Projector, options: Options, records: Records, octree: Octree
) -> Pool:
    def load(name: str) -> tuple[Rows, NDArray[np.int64]]:
        rows = records(cloud_of(source, projector, name))
        return rows, octree.cells(places_of(rows), octree.block_level)[:, :2]

    corner = octree.corner[:2] * SCALE_M + records.offset_m[:2]
    grid = Grid(corner, octree.edge(octree.block_level) * SCALE_M)
    return Pool(plan(source, projector, options, grid, slack=MARGIN_STEPS * SCALE_M), load)


class _Walk:
    """Depth first over the squares of the plane that hold blocks with points."""

    def __init__(self, octree: Octree, pool: Pool, out: CopcFile) -> None:
        self._octree, self._pool, self._out = octree, pool, out
        self._waiting: list[list[Rows]] = [[] for _ in range(octree.top + 1)]
        self._squares: list[set[Block]] = [set(pool.parts)]
        for _ in range(octree.top - octree.block_level):
            self._squares.append({(x >> 1, y >> 1) for x, y in self._squares[-1]})

    def run(self) -> None:
        self._visit(self._octree.top, (0, 0))

    def _visit(self, level: int, square: Block) -> None:
        if square not in self._squares[level - self._octree.block_level]:
            return
        if level == self._octree.block_level:
            self._block(square)
        else:
            for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
                self._visit(level - 1, (2 * square[0] + x, 2 * square[1] + y))
        waiting, self._waiting[level] = self._waiting[level], []
        if waiting:
            self._write_level(level, joined(waiting))

    def _block(self, block: Block) -> None:
        """Write what is finer than a block, keep the rest for later."""
        parts = self._pool.take(block)
        if not parts:
            return
        rows = joined(parts)
        levels = self._octree.levels(places_of(rows), rows["level"])
        for level in range(self._octree.top + 1):
            of_level = picked(rows, np.flatnonzero(levels == level))
            if len(of_level) and level < self._octree.block_level:
                self._write_level(level, of_level)
            elif len(of_level):
                self._waiting[level].append(of_level)

    def _write_level(self, level: int, rows: Rows) -> None:
        """All nodes of a level that these rows make."""
        cells = self._octree.cells(places_of(rows), level)
        flat = np.column_stack((cells[:, 0] * (1 << (self._octree.top - level)) + cells[:, 1], cells[:, 2]))
        for (xy, z), inside in split(rows, flat).items():
            x, y = divmod(xy, 1 << (self._octree.top - level))
            self._out.node(self._octree.key(level, (x, y, z)), inside)
