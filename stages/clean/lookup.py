"""Verdicts by place: those of the tiles that a chunk's points lie in, tile by tile from their files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import BRICK_VOXELS, Cleared, Standing
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import DeskewedScan
from scanloom.stages.clean.field import I4, I8, brick_key, brick_table, inner, row_of, voxel_at
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import EMPTY, Int

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]

UNKNOWN, STANDS = np.uint8(Standing.UNKNOWN), np.uint8(Standing.STANDS)
AHEAD_M = 150.0
"""Tiles within this distance of a scan are opened; farther ones are let go."""


class Verdicts:
    """Looks verdicts up; holds only the tiles around the last scan."""

    def __init__(self, cleared: Parts[Cleared]) -> None:
        self._cleared = cleared
        where = [c["tile"].split("_") for c in cleared.coordinates()]
        self._tiles = np.array([[int(a), int(b)] for a, b in where], np.int64).reshape(-1, 2)
        self._held: frozenset[int] = frozenset()
        self._size_m = cleared[0].tile_size_m if len(cleared) else 0.0
        self._voxel_m = cleared[0].voxel_size_m if len(cleared) else 1.0
        self._place = np.full(2, np.nan)
        self._index([])

    def of(self, scan: DeskewedScan, classes: U1, asked: B1, T_world_lidar: F8) -> U1:
        """Standing (n,) of the points of a scan whose class is `asked` (classes,), UNKNOWN of the others."""
        self._move_to(T_world_lidar[:2, 3])
        said: U1 = standing(
            scan.x_m, scan.y_m, scan.z_m, classes, asked, np.ascontiguousarray(T_world_lidar), 1.0 / self._voxel_m,
            self._keys, self._rows, self._verdict,
        )  # fmt: skip
        return said

    def around(self, scan: DeskewedScan, asked: I8, T_world_lidar: F8) -> U1:
        """How many (n, 2) of the 26 voxels around the points `asked` (m,) stand, and moved or have changed; 0 of the others."""
        self._move_to(T_world_lidar[:2, 3])
        counted: U1 = standing_around(
            scan.x_m, scan.y_m, scan.z_m, asked, np.ascontiguousarray(T_world_lidar), 1.0 / self._voxel_m,
            self._keys, self._rows, self._verdict,
        )  # fmt: skip
        return counted

    def _move_to(self, place: F8) -> None:
        if np.array_equal(place, self._place):
            return
        self._place = place.copy()
        low = self._tiles * self._size_m
        off = np.maximum(np.maximum(low - place, place - low - self._size_m), 0.0)
        distance = np.hypot(off[:, 0], off[:, 1])
        if all(n in self._held for n in np.flatnonzero(distance < 0.7 * AHEAD_M)):
            return
        wanted = np.flatnonzero(distance < AHEAD_M)
        self._held = frozenset(wanted.tolist())
        self._index([self._cleared[int(n)] for n in wanted])

    def _index(self, tables: list[Cleared]) -> None:
        """One table of all; a brick at a border is in two tiles, each with verdicts on its own voxels only."""
        brick = np.concatenate([np.empty(0, np.int64), *(t.brick for t in tables)])
        said = np.concatenate([np.empty((0, BRICK_VOXELS), np.uint8), *(t.verdict for t in tables)])
        bricks, first, row = np.unique(brick, return_index=True, return_inverse=True)
        self._verdict = said[first]
        again = np.setdiff1d(np.arange(len(brick)), first)
        np.maximum.at(self._verdict, row[again], said[again])
        self._keys, self._rows = brick_table(bricks, len(bricks))


@kernel
def standing(
    x: F4, y: F4, z: F4, classes: U1, asked: B1, T: F8, per_m: float, keys: I8, rows: I4, verdict: U1
) -> U1:  # fmt: skip
    """Verdict (n,) on the voxel of each point whose class is asked."""
    out = np.zeros(len(x), np.uint8)
    last: Int = EMPTY
    row: Int = -1
    for n in range(len(x)):
        if not asked[classes[n]]:
            continue
        i, j, k = voxel_at(float(x[n]), float(y[n]), float(z[n]), T, per_m)
        key = brick_key(i, j, k)
        if key != last:
            row, last = row_of(keys, rows, key), key
        if row >= 0:
            out[n] = verdict[row, inner(i, j, k)]
    return out


@kernel
def standing_around(
    x: F4, y: F4, z: F4, asked: I8, T: F8, per_m: float, keys: I8, rows: I4, verdict: U1
) -> U1:  # fmt: skip
    """Voxels (n, 2) around that of each point asked about that stand, and that moved or have changed."""
    out = np.zeros((len(x), 2), np.uint8)
    near = np.empty(8, np.int64)
    for n in asked:
        i, j, k = voxel_at(float(x[n]), float(y[n]), float(z[n]), T, per_m)
        _bricks_around(i, j, k, keys, rows, near)
        stands, went = 0, 0
        for u in range(i - 1, i + 2):
            for v in range(j - 1, j + 2):
                for w in range(k - 1, k + 2):
                    said = _verdict_at(u, v, w, i - 1, j - 1, k - 1, near, verdict)
                    stands, went = stands + int(said == STANDS), went + int(said > STANDS)
        own = _verdict_at(i, j, k, i - 1, j - 1, k - 1, near, verdict)
        out[n, 0], out[n, 1] = stands - int(own == STANDS), went - int(own > STANDS)
    return out


@kernel
def _bricks_around(i: Int, j: Int, k: Int, keys: I8, rows: I4, near: I8) -> None:
    """Rows (8,) of the bricks that a voxel and those around it lie in, by whether it is the farther along each axis."""
    last: Int = EMPTY
    row: Int = -1
    for q in range(8):
        key = brick_key(i + 1 if q & 4 else i - 1, j + 1 if q & 2 else j - 1, k + 1 if q & 1 else k - 1)
        if key != last:
            row, last = row_of(keys, rows, key), key
        near[q] = row


@kernel
def _verdict_at(u: Int, v: Int, w: Int, i: Int, j: Int, k: Int, near: I8, verdict: U1) -> int:
    """Of one of the voxels from (i, j, k) on, up to two on along each axis, given the rows of their bricks (8,)."""
    farther = 4 * int(u >> 3 > i >> 3) + 2 * int(v >> 3 > j >> 3) + int(w >> 3 > k >> 3)
    row = near[farther]
    return verdict[row, inner(u, v, w)] if row >= 0 else UNKNOWN  # type: ignore[return-value]
