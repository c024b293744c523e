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

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]

STANDS = int(Standing.STANDS)
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
        self._index([])

    def of(self, scan: DeskewedScan, asked: B1, T_world_lidar: F8) -> U1:
        """Standing (n,) of the points of a scan that are asked, UNKNOWN of the others."""
        self._move_to(T_world_lidar[:2, 3])
        said: U1 = standing(
            scan.x_m, scan.y_m, scan.z_m, asked, np.ascontiguousarray(T_world_lidar), 1.0 / self._voxel_m,
            self._keys, self._rows, self._verdict,
        )  # fmt: skip
        return said

    def around(self, scan: DeskewedScan, asked: B1, T_world_lidar: F8) -> U1:
        """How many (n, 2) of the 26 voxels around the points that are asked stand, and moved or have changed."""
        self._move_to(T_world_lidar[:2, 3])
        counted: U1 = standing_around(
            scan.x_m, scan.y_m, scan.z_m, asked, np.ascontiguousarray(T_world_lidar), 1.0 / self._voxel_m,
            self._keys, self._rows, self._verdict,
        )  # fmt: skip
        return counted

    def _move_to(self, place: F8) -> None:
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
    x: F4, y: F4, z: F4, asked: B1, T: F8, per_m: float, keys: I8, rows: I4, verdict: U1
) -> U1:  # fmt: skip
    """Verdict (n,) on the voxel of each asked point."""
    out = np.zeros(len(x), np.uint8)
    for n in range(len(x)):
        if not asked[n]:
            continue
        i, j, k = voxel_at(float(x[n]), float(y[n]), float(z[n]), T, per_m)
        row = row_of(keys, rows, brick_key(i, j, k))
        if row >= 0:
            out[n] = verdict[row, inner(i, j, k)]
    return out


@kernel
def standing_around(
    x: F4, y: F4, z: F4, asked: B1, T: F8, per_m: float, keys: I8, rows: I4, verdict: U1
) -> U1:  # fmt: skip
    """Voxels (n, 2) around that of each asked point that stand, and that moved or have changed."""
    out = np.zeros((len(x), 2), np.uint8)
    for n in range(len(x)):
        if not asked[n]:
            continue
        i, j, k = voxel_at(float(x[n]), float(y[n]), float(z[n]), T, per_m)
        own = brick_key(i, j, k)
        own_row = row_of(keys, rows, own)
        for q in range(27):
            u, v, w = i + q // 9 - 1, j + q // 3 % 3 - 1, k + q % 3 - 1
            key = brick_key(u, v, w)
            row = own_row if key == own else row_of(keys, rows, key)
            if row < 0 or q == 13:
                continue
            said = verdict[row, inner(u, v, w)]
            if said == STANDS:
                out[n, 0] += 1
            elif said > STANDS:
                out[n, 1] += 1
    return out
