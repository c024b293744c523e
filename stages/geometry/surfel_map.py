"""A local map of surfaces: cells that sum up the points that fell into them, and the surface through each.

Blocks of 2 x 2 x 2 cells lie in a hash table. A cell keeps number, sum and sum of products of its first points; the
surface at a cell is that of all points in the 27 cells around it, fitted when it is first asked for and again when the
map has grown there. A point's partner is the surface of its own cell: only where that is empty the nearest is looked for.
Gaussian voxels as in VGICP (Koide, Yokozuka, Oishi, Banno, ICRA 2021), smoothed over their neighbours. Sums are float32
from a block's corner.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.surfaces import eigen_symmetric_3
from scanloom.stages.geometry.voxel_map import (
    F4,
    FIRST_CAPACITY,
    I4,
    I8,
    SURFACE_COLUMNS,
    UNFITTED,
    corners,
    index_voxels,
    shape_weight,
)
from scanloom.stages.geometry.voxels import EMPTY, Float, Int, find_slot, pack, table_length, unpack

CELLS = 8
"""Of a block: bit 2 of a cell's number is its place along x, bit 1 along y, bit 0 along z."""
SUMS = 10
"""Of a cell: number of points, x, y, z, xx, xy, xz, yy, yz, zz."""
LEAST_AROUND = 8
"""Points that a surface needs: with fewer it is that of two beams and their noise."""


class SurfelMap:
    """Surfaces of one frame, in blocks of edge `voxel_size_m`; cells are half as wide.

    Parameters
    ----------
    voxel_size_m : edge of a block; also the farthest a partner is looked for.
    points_per_cell : what comes to a cell that has as many is passed over: the first points stay the map's anchor.
    refit_after : surfaces are fitted again after this many calls of `insert`, where points were added.
    """

    def __init__(self, voxel_size_m: float, points_per_cell: int = 30, *, refit_after: int = 20) -> None:
        self.voxel_size_m = float(voxel_size_m)
        self.points_per_cell = int(points_per_cell)
        self.refit_after = refit_after
        self.inserts = 0
        self.blocks = 0
        self.keys: I8 = np.full(table_length(FIRST_CAPACITY), EMPTY, np.int64)
        self.values: I4 = np.zeros(len(self.keys), np.int32)
        self.block_key, self.changed, self.sums, self.surface, self.fitted = _blank(FIRST_CAPACITY)

    def __len__(self) -> int:
        """Number of points."""
        return int(self.sums[: self.blocks, :, 0].sum())

    def insert(self, points: ArrayLike, T: F8 | None = None) -> int:
        """Add points (n, 3), m, moved by T (4, 4) first; those not finite are passed over. Returns how many stay."""
        rows = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        self.inserts += 1
        if self.blocks + len(rows) > len(self.block_key):
            self._keep(np.arange(self.blocks), max(self.blocks + len(rows), 2 * len(self.block_key)))
        blocks, added = _insert(
            rows, np.eye(4) if T is None else T, self.voxel_size_m, self.points_per_cell, self.inserts, self.keys, self.values,
            self.block_key, self.changed, self.sums, self.blocks,
        )  # fmt: skip
        self.blocks = int(blocks)
        return int(added)

    def points(self) -> F8:
        """Mean (k, 3) of the points in every cell, m."""
        number = self.sums[: self.blocks, :, 0]
        means = self.sums[: self.blocks, :, 1:4] / np.maximum(number, 1.0)[:, :, None]
        return (self._corners()[:, None, :] + means)[number > 0]

    def drop_far(self, center: ArrayLike, radius_m: float) -> None:
        """Forget blocks whose corner is farther than `radius_m` from `center` (3,)."""
        distance = np.linalg.norm(self._corners() - np.asarray(center, float), axis=1)
        kept = np.flatnonzero(distance <= radius_m)
        if len(kept) < self.blocks:
            self._keep(kept, len(self.block_key) // (2 if 4 * len(kept) < len(self.block_key) else 1))

    def partners(
        self, points: F8, T: F8, max_distance_m: float, mean: F8, normal: F8, shape: F8, normal_variance: F8
    ) -> None:
        """Surface of the map at every point (n, 3) moved by T: mean, normal (n, 3), weight of its shape (n,), 0 without one,
        and variance of the normal's direction (n,), rad2."""
        limit2 = min(max_distance_m, self.voxel_size_m) ** 2
        _partners(
            points, T, limit2, self.voxel_size_m, self.keys, self.values, self.block_key, self.changed, self.sums,
            self.surface, self.fitted, self.inserts, self.refit_after, mean, normal, shape, normal_variance,
        )  # fmt: skip

    def _corners(self) -> F8:
        return corners(self.block_key[: self.blocks], self.voxel_size_m)

    def _keep(self, kept: I8, capacity: int) -> None:
        """Move the kept blocks into arrays of the given capacity and rebuild the table."""
        old: tuple[NDArray[Any], ...] = (self.block_key, self.changed, self.sums, self.surface, self.fitted)
        new: tuple[NDArray[Any], ...] = _blank(max(capacity, FIRST_CAPACITY))
        for before, after in zip(old, new, strict=True):
            after[: len(kept)] = before[kept]
        self.block_key, self.changed, self.sums, self.surface, self.fitted = new
        self.blocks = len(kept)
        self.keys = np.full(table_length(len(self.block_key)), EMPTY, np.int64)
        self.values = np.zeros(len(self.keys), np.int32)
        index_voxels(self.block_key, self.blocks, self.keys, self.values)


def _blank(capacity: int) -> tuple[I8, I4, F4, F4, I4]:
    return (
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int32),
        np.zeros((capacity, CELLS, SUMS), np.float32),
        np.zeros((capacity, CELLS, SURFACE_COLUMNS), np.float32),
        np.full((capacity, CELLS), UNFITTED, np.int32),
    )


@kernel
def _insert(
    points: F8, T: F8, size: Float, most: Int, inserts: Int, keys: I8, values: I4, block_key: I8, changed: I4, sums: F4,
    blocks: Int,
) -> tuple[Int, Int]:  # fmt: skip
    per_m, half = 1.0 / size, 0.5 * size
    added = 0
    s: F4
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)):
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        i, j, k = np.int64(np.floor(x * per_m)), np.int64(np.floor(y * per_m)), np.int64(np.floor(z * per_m))
        x, y, z = x - i * size, y - j * size, z - k * size
        key = pack(i, j, k)
        slot = find_slot(keys, key)
        if keys[slot] == EMPTY:
            keys[slot], block_key[blocks] = key, key
            values[slot] = blocks
            blocks += 1
        v = values[slot]
        s = sums[v, cell_of(x, y, z, half)]
        if s[0] >= most:
            continue
        changed[v] = inserts
        added += 1
        s[0], s[1], s[2], s[3] = s[0] + 1.0, s[1] + x, s[2] + y, s[3] + z
        s[4], s[5], s[6] = s[4] + x * x, s[5] + x * y, s[6] + x * z
        s[7], s[8], s[9] = s[7] + y * y, s[8] + y * z, s[9] + z * z
    return blocks, added


@kernel
def cell_of(x: Float, y: Float, z: Float, half: Float) -> Int:
    """Number of the cell at a place in a block, from its corner."""
    return (4 if x >= half else 0) + (2 if y >= half else 0) + (1 if z >= half else 0)


@kernel
def _partners(
    points: F8, T: F8, limit2: Float, size: Float, keys: I8, values: I4, block_key: I8, changed: I4, sums: F4, surface: F4,
    fitted: I4, inserts: Int, refit_after: Int, mean: F8, normal: F8, shape: F8, normal_variance: F8,
) -> None:  # fmt: skip
    a, vectors = np.empty((3, 3)), np.empty((3, 3))
    per_m, half = 1.0 / size, 0.5 * size
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        i, j, k = np.int64(np.floor(x * per_m)), np.int64(np.floor(y * per_m)), np.int64(np.floor(z * per_m))
        x, y, z = x - i * size, y - j * size, z - k * size
        c: Int = cell_of(x, y, z, half)
        slot = find_slot(keys, pack(i, j, k))
        v: int = -1
        if keys[slot] != EMPTY and sums[values[slot], c, 0] > 0.0:
            v = int(values[slot])
        else:
            v, c = _nearest_cell(i, j, k, c, x, y, z, limit2, size, keys, values, sums)
        if v < 0:
            shape[n] = 0.0
            continue
        if inserts - fitted[v, c] > refit_after and changed[v] > fitted[v, c]:
            _fit(v, c, size, keys, values, block_key, sums, surface, a, vectors)
            fitted[v, c] = inserts
        bi, bj, bk = unpack(block_key[v])
        mean[n, 0] = bi * size + surface[v, c, 0]
        mean[n, 1] = bj * size + surface[v, c, 1]
        mean[n, 2] = bk * size + surface[v, c, 2]
        normal[n, 0], normal[n, 1], normal[n, 2] = surface[v, c, 3], surface[v, c, 4], surface[v, c, 5]
        shape[n] = surface[v, c, 6]
        normal_variance[n] = surface[v, c, 7]


@kernel
def _outside(cell: Int, di: Int, dj: Int, dk: Int) -> bool:
    """Whether a cell of the block in direction (di, dj, dk) is on that block's far side: it is no neighbour then."""
    along_x = (di < 0 and cell < 4) or (di > 0 and cell >= 4)
    along_y = (dj < 0 and (cell & 2) == 0) or (dj > 0 and (cell & 2) != 0)
    along_z = (dk < 0 and (cell & 1) == 0) or (dk > 0 and (cell & 1) != 0)
    return bool(along_x or along_y or along_z)


@kernel
def _nearest_cell(
    i: Int, j: Int, k: Int, c: Int, x: Float, y: Float, z: Float, limit2: Float, size: Float, keys: I8, values: I4,
    sums: F4,
) -> tuple[int, Int]:  # fmt: skip
    """Of the 27 cells around cell c of block (i, j, k) the one with the nearest mean: block and cell; -1 beyond the limit."""
    best = limit2
    best_v: int = -1
    best_c: Int = -1
    for corner in range(8):
        di, dj, dk = _step(c, corner)
        slot = find_slot(keys, pack(i + di, j + dj, k + dk))
        if keys[slot] == EMPTY:
            continue
        v = values[slot]
        px, py, pz = x - di * size, y - dj * size, z - dk * size
        for e in range(CELLS):
            m = sums[v, e, 0]
            if m == 0.0 or _outside(e, di, dj, dk):
                continue
            dx, dy, dz = sums[v, e, 1] / m - px, sums[v, e, 2] / m - py, sums[v, e, 3] / m - pz
            d2 = dx * dx + dy * dy + dz * dz
            if d2 < best:
                best, best_v, best_c = d2, int(v), e
    return best_v, best_c


@kernel
def _step(c: Int, corner: Int) -> tuple[Int, Int, Int]:
    """Steps to the 8 blocks that hold the 27 cells around cell c."""
    return (
        ((c >> 2) & 1) - 1 + ((corner >> 2) & 1),
        ((c >> 1) & 1) - 1 + ((corner >> 1) & 1),
        (c & 1) - 1 + (corner & 1),
    )


@kernel
def _fit(
    v: Int,
    c: Int,
    size: Float,
    keys: I8,
    values: I4,
    block_key: I8,
    sums: F4,
    surface: F4,
    a: F8,
    vectors: F8,
) -> None:
    """Surface through the points in the 27 cells around cell c of block v, if these are enough; `a`, `vectors` are scratch."""
    i, j, k = unpack(block_key[v])
    n = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for corner in range(8):
        di, dj, dk = _step(c, corner)
        slot = find_slot(keys, pack(i + di, j + dj, k + dk))
        if keys[slot] == EMPTY:
            continue
        w = values[slot]
        m = tx = ty = tz = txx = txy = txz = tyy = tyz = tzz = 0.0
        for e in range(CELLS):
            s = sums[w, e]
            if s[0] == 0.0 or _outside(e, di, dj, dk):
                continue
            m, tx, ty, tz = m + float(s[0]), tx + float(s[1]), ty + float(s[2]), tz + float(s[3])
            txx, txy, txz = txx + float(s[4]), txy + float(s[5]), txz + float(s[6])
            tyy, tyz, tzz = tyy + float(s[7]), tyz + float(s[8]), tzz + float(s[9])
        # Sums about the corner of that block, now about the corner of block v.
        ox, oy, oz = float(di * size), float(dj * size), float(dk * size)
        n, sx, sy, sz = n + m, sx + tx + m * ox, sy + ty + m * oy, sz + tz + m * oz
        xx += txx + 2.0 * ox * tx + m * ox * ox
        xy += txy + ox * ty + oy * tx + m * ox * oy
        xz += txz + ox * tz + oz * tx + m * ox * oz
        yy += tyy + 2.0 * oy * ty + m * oy * oy
        yz += tyz + oy * tz + oz * ty + m * oy * oz
        zz += tzz + 2.0 * oz * tz + m * oz * oz
    sx, sy, sz = sx / n, sy / n, sz / n
    a[0, 0], a[1, 1], a[2, 2] = xx / n - sx * sx, yy / n - sy * sy, zz / n - sz * sz
    a[0, 1] = a[1, 0] = xy / n - sx * sy
    a[0, 2] = a[2, 0] = xz / n - sx * sz
    a[1, 2] = a[2, 1] = yz / n - sy * sz
    surface[v, c, 6] = 0.0
    if n < LEAST_AROUND:
        return
    eigen_symmetric_3(a, vectors)
    surface[v, c, 0], surface[v, c, 1], surface[v, c, 2] = sx, sy, sz
    for r in range(3):
        surface[v, c, 3 + r] = vectors[r, 0]
    surface[v, c, 6] = shape_weight(a[0, 0], a[1, 1], a[2, 2], n)
    surface[v, c, 7] = max(a[0, 0], 0.0) / ((n - 3.0) * max(a[1, 1], 1e-12))
