"""Running sums per voxel: an open-addressing hash in compiled code, one cache line per voxel.

Coordinates and intensities are rounded to fixed steps of a power of two before they are summed. Such sums are exact
in doubles, so that the map does not depend on the order in which scans, chunks and sessions arrive.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import StageError
from scanloom.stages.geometry.kernels import kernel

F8 = NDArray[np.float64]
Int = int | np.integer[Any]
"""A whole number inside a kernel, where numpy scalars pass for Python's."""

STEP_M = 2.0**-13
"""Rounding of coordinates, 0.12 mm: a hundredth of a good LiDAR's noise."""
INTENSITY_STEP = 2.0**-10

FIRST_SLOTS = 1 << 19
"""Room for one scan of a large LiDAR and the voxels of its neighbours, so that the table seldom grows."""
MAX_VOXELS_PER_SIDE = 1024
_TILE_BITS, _SIDE_BITS, _HEIGHT_BITS = 12, 10, 19
_TILE_HALF, _HEIGHT_HALF = 1 << (_TILE_BITS - 1), 1 << (_HEIGHT_BITS - 1)
_TILE_SHIFT = 2 * _SIDE_BITS + _HEIGHT_BITS
_BLOCK = 1 | 1 << _HEIGHT_BITS | 1 << (_SIDE_BITS + _HEIGHT_BITS)
"""The lowest bit of each of the three indices."""
STEP_X, STEP_Y = 1 << (_SIDE_BITS + _HEIGHT_BITS), 1 << _HEIGHT_BITS
"""From a packed voxel to the next along x, and along y."""
_EMPTY = -1

# Layout of one record of eight doubles (64 bytes). Points of ground are counted in the upper half of the count.
_X, _Y, _Z, _INTENSITY, _COUNT, _SCANS, _FIRST, _LAST = range(8)
_SUMS = 5
_ONE_OF_GROUND = 2.0**32
VIEW_STEPS = 127.0
"""Components of directions are kept in such steps of a unit vector."""


@dataclass(frozen=True)
class TileSums:
    """Voxels of one tile, ordered by (x, y, z) index. See `schemas.tiles.Piece` for the columns."""

    tile: tuple[int, int]
    voxel: NDArray[np.int64]
    count: NDArray[np.int32]
    sum_x_m: NDArray[np.float64]
    sum_y_m: NDArray[np.float64]
    sum_z_m: NDArray[np.float64]
    sum_intensity: NDArray[np.float64]
    ground_count: NDArray[np.int32]
    scan_count: NDArray[np.int32]
    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]
    view: NDArray[np.int8]


def voxel_indices(voxel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices (n, 3) along x, y, z from the tile's corner of the packed voxels (n,) of a piece."""
    side = (1 << _SIDE_BITS) - 1
    z = (voxel & ((1 << _HEIGHT_BITS) - 1)) - _HEIGHT_HALF
    return np.column_stack(((voxel >> (_SIDE_BITS + _HEIGHT_BITS)) & side, (voxel >> _HEIGHT_BITS) & side, z))


class VoxelSums:
    """Sums of points per voxel, voxels counted from the corner of the tile they lie in.

    A point (x, y) belongs to tile (floor(x / tile), floor(y / tile)); a tile holds a whole number of voxels, so no
    voxel straddles two tiles.
    """

    def __init__(self, voxel_size_m: float, tile_size_m: float) -> None:
        self._voxel_m = voxel_size_m
        self._tile_m = tile_size_m
        self._side = round(tile_size_m / voxel_size_m)
        self._used = 0
        self._keys, self._records = np.empty(0, np.int64), np.empty((0, 8))
        self._stamps_ns: list[int] = []
        self._places_m: list[NDArray[np.float64]] = []
        self._runs = _Runs(0)
        self._rehash(FIRST_SLOTS)

    def __len__(self) -> int:
        return self._used

    def add(
        self,
        points: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
        intensity: NDArray[np.float32],
        classes: NDArray[np.uint8],
        keep: NDArray[np.bool_],
        ground_class: int,
        T: NDArray[np.float64],
        stamp_ns: int,
    ) -> None:
        """Add one scan: x, y, z (n,) f32 in the LiDAR frame, its classes (n,), T_world_lidar (4, 4), reference time.

        `keep` (256,) says for each class whether it enters the map. Points that are not finite are skipped.

        Raises
        ------
        StageError : a point lies further from the origin of the map than the grid reaches.
        """
        n = len(points[0])
        self._stamps_ns.append(stamp_ns)
        self._places_m.append(T[:3, 3].copy())
        self._grow_for(n)
        if len(self._runs.keys) < n:
            self._runs = _Runs(n + n // 8)
        runs = self._runs
        found = _runs(
            *points, intensity, classes, keep, ground_class, T, self._voxel_m, self._tile_m, self._side, runs.keys,
            runs.sums,
        )  # fmt: skip
        if found < 0:
            raise StageError(
                f"a point lies more than {_TILE_HALF * self._tile_m / 1000:.0f} km from the origin of the map",
                next_step="look at the poses of this session: they have most likely diverged",
            )
        self._used = _find(runs.keys[:found], runs.rows, self._table, self._keys, self._used)
        _add(runs.rows[:found], runs.sums, self._records, len(self._stamps_ns))

    def tiles(self) -> list[TileSums]:
        """All voxels, tile by tile, ordered by tile and voxel."""
        keys = self._keys[: self._used]
        order = np.argsort(keys)
        keys = keys[order]
        stamps = np.array(self._stamps_ns, np.int64)
        places = np.array(self._places_m).reshape(-1, 3)
        columns: tuple[Any, ...] = (
            keys & ((1 << _TILE_SHIFT) - 1),
            *_columns(keys, order, self._records, stamps, places, self._tile_m),
        )
        starts = np.flatnonzero(np.diff(keys >> _TILE_SHIFT, prepend=_EMPTY))
        ends = np.append(starts[1:], len(keys))
        return [TileSums(_tile(keys[a]), *(c[a:b] for c in columns)) for a, b in zip(starts, ends)]

    def _grow_for(self, points: int) -> None:
        """Room for `points` new voxels at a load of at most one half."""
        slots = len(self._table)
        while slots < 2 * (self._used + points):
            slots *= 2
        if slots != len(self._table):
            self._rehash(slots)

    def _rehash(self, slots: int) -> None:
        """A table of so many slots, and dense arrays half as long."""
        keys = np.empty(slots // 2, np.int64)
        records = np.zeros((slots // 2, 8))
        keys[: self._used] = self._keys[: self._used]
        records[: self._used] = self._records[: self._used]
        self._keys, self._records = keys, records
        self._table = np.full((slots, 2), _EMPTY, np.int64)
        _insert_all(self._keys, self._used, self._table)


class _Runs:
    """Room for the runs of one scan: voxel, sums and place of each. Kept from scan to scan, since fresh memory is slow."""

    def __init__(self, points: int) -> None:
        self.keys = np.empty(points, np.int64)
        self.sums = np.empty((points, _SUMS))
        self.rows = np.empty(points, np.int32)


def _tile(key: int) -> tuple[int, int]:
    tile = int(key) >> _TILE_SHIFT
    return (tile >> _TILE_BITS) - _TILE_HALF, (tile & ((1 << _TILE_BITS) - 1)) - _TILE_HALF


@kernel
def _hash(key: Int, mask: Int) -> Int:
    """Where to look first: blocks of 2 x 2 x 2 voxels stay together, for the cache's sake, the blocks are scattered.

    Fibonacci hashing: the high bits of block * 2^64/phi.
    """
    block = np.uint64(key) & ~np.uint64(_BLOCK)
    inside = (key & 1) | ((key >> (_HEIGHT_BITS - 1)) & 2) | ((key >> (_SIDE_BITS + _HEIGHT_BITS - 2)) & 4)
    mixed = block * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(((mixed >> np.uint64(24)) << np.uint64(3)) & np.uint64(mask)) | np.int64(inside)


@kernel
def _insert_all(keys: NDArray[np.int64], used: int, table: NDArray[np.int64]) -> None:
    """Fill an empty table of (key, number) with the voxels known so far."""
    mask = len(table) - 1
    for i in range(used):
        at = _hash(keys[i], mask)
        while table[at, 0] != _EMPTY:
            at = (at + 1) & mask
        table[at, 0], table[at, 1] = keys[i], i


@kernel
def _runs(
    xs: NDArray[np.float32], ys: NDArray[np.float32], zs: NDArray[np.float32], intensity: NDArray[np.float32],
    classes: NDArray[np.uint8], keep: NDArray[np.bool_], ground_class: int, T: NDArray[np.float64],
    voxel_m: float, tile_m: float, side: int, keys: NDArray[np.int64], sums: NDArray[np.float64],
) -> int:  # fmt: skip
    """Kept points of one scan, those that follow each other in one voxel added up: near the sensor most do.

    Fills `keys` (n,) and `sums` (n, 5): x, y, z from the tile's corner and intensity in whole steps, points (of ground:
    see `_ONE_OF_GROUND`); returns their number, or -1 when a point is out of the grid.
    """
    runs = 0
    last = np.int64(_EMPTY)
    sx, sy, sz, light, points = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(xs)):
        if not keep[classes[i]]:
            continue
        x = T[0, 0] * xs[i] + T[0, 1] * ys[i] + T[0, 2] * zs[i] + T[0, 3]
        y = T[1, 0] * xs[i] + T[1, 1] * ys[i] + T[1, 2] * zs[i] + T[1, 3]
        z = T[2, 0] * xs[i] + T[2, 1] * ys[i] + T[2, 2] * zs[i] + T[2, 3]
        if not np.isfinite(x + y + z):
            continue
        tx, ty, vz = np.floor(x / tile_m), np.floor(y / tile_m), np.floor(z / voxel_m)
        x, y = x - tx * tile_m, y - ty * tile_m
        if abs(tx) >= _TILE_HALF or abs(ty) >= _TILE_HALF or abs(vz) >= _HEIGHT_HALF:
            return -1
        # Rounding of the quotient may touch the upper border, which belongs to the tile's last voxel.
        vx: Any = min(np.int64(x / voxel_m), side - 1)
        vy: Any = min(np.int64(y / voxel_m), side - 1)
        tile = ((np.int64(tx) + _TILE_HALF) << _TILE_BITS) | (np.int64(ty) + _TILE_HALF)
        inner = (((vx << _SIDE_BITS) | vy) << _HEIGHT_BITS) | (np.int64(vz) + _HEIGHT_HALF)
        key = (tile << _TILE_SHIFT) | inner
        if key != last:
            last = key
            runs += 1
            keys[runs - 1] = key
            sx, sy, sz, light, points = 0.0, 0.0, 0.0, 0.0, 0.0
        sx += np.rint(x / STEP_M)
        sy += np.rint(y / STEP_M)
        sz += np.rint(z / STEP_M)
        light += np.rint(intensity[i] / INTENSITY_STEP) if np.isfinite(intensity[i]) else 0.0
        points += 1.0 + _ONE_OF_GROUND if classes[i] == ground_class else 1.0
        into = sums[runs - 1]
        into[_X], into[_Y], into[_Z], into[_INTENSITY] = sx, sy, sz, light
        into[_COUNT] = points
    return runs


@kernel
def _find(
    wanted: NDArray[np.int64],
    rows: NDArray[np.int32],
    table: NDArray[np.int64],
    keys: NDArray[np.int64],
    used: int,
) -> int:
    """Number of the voxel of each run, new voxels included; returns the number of voxels.

    A loop of its own, short enough for the processor to wait for many cache lines at once.
    """
    mask = len(table) - 1
    for i in range(len(wanted)):
        key = wanted[i]
        at = _hash(key, mask)
        while table[at, 0] != key and table[at, 0] != _EMPTY:
            at = (at + 1) & mask
        if table[at, 0] == _EMPTY:
            table[at, 0], table[at, 1], keys[used] = key, used, key
            used += 1
        rows[i] = table[at, 1]
    return used


@kernel
def _add(rows: NDArray[np.int32], sums: NDArray[np.float64], records: NDArray[np.float64], scan: int) -> None:
    """Add each run to its voxel."""
    for i in range(len(rows)):
        record = records[rows[i]]
        if record[_COUNT] == 0.0:
            record[_FIRST] = scan
        for k in range(_SUMS):
            record[k] += sums[i, k]
        if record[_LAST] != scan:
            record[_SCANS] += 1.0
            record[_LAST] = scan


@kernel
def _columns(
    keys: NDArray[np.int64], order: NDArray[np.int64], records: NDArray[np.float64], stamps_ns: NDArray[np.int64],
    places_m: NDArray[np.float64], tile_m: float,
) -> tuple[
    NDArray[np.int32], F8, F8, F8, F8, NDArray[np.int32], NDArray[np.int32], NDArray[np.int64], NDArray[np.int64],
    NDArray[np.int8],
]:  # fmt: skip
    """Columns of a piece but for the voxel, rows in this order; scans are numbered from one."""
    n = len(order)
    count, ground, scans = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    x, y, z, intensity = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    first, last, view = np.empty(n, np.int64), np.empty(n, np.int64), np.empty((n, 3), np.int8)
    for i in range(n):
        record = records[order[i]]
        of_ground = np.floor(record[_COUNT] / _ONE_OF_GROUND)
        points = record[_COUNT] - of_ground * _ONE_OF_GROUND
        x[i], y[i], z[i] = record[_X] * STEP_M, record[_Y] * STEP_M, record[_Z] * STEP_M
        intensity[i] = record[_INTENSITY] * INTENSITY_STEP
        count[i], ground[i], scans[i] = points, of_ground, record[_SCANS]
        at = np.int64(record[_FIRST]) - 1
        first[i], last[i] = stamps_ns[at], stamps_ns[np.int64(record[_LAST]) - 1]
        tile = keys[i] >> _TILE_SHIFT
        dx = places_m[at, 0] - ((tile >> _TILE_BITS) - _TILE_HALF) * tile_m - x[i] / points
        dy = places_m[at, 1] - ((tile & ((1 << _TILE_BITS) - 1)) - _TILE_HALF) * tile_m - y[i] / points
        dz = places_m[at, 2] - z[i] / points
        scale = VIEW_STEPS / max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
        view[i, 0], view[i, 1], view[i, 2] = np.rint(dx * scale), np.rint(dy * scale), np.rint(dz * scale)
    return count, x, y, z, intensity, ground, scans, first, last, view
