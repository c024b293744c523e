"""A local map of points in voxels, with the surface through each point fitted when it is first asked for.

Each voxel keeps at most `points_per_voxel` points that are no closer than a spacing (as KISS-ICP, arXiv 2209.15397).
The surface through a stored point is the mean and normal of all stored points around it; it is fitted on demand,
kept, and fitted again once the map has grown by a few scans. Points are float32 from their voxel's corner.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.surfaces import eigen_symmetric_3
from scanloom.stages.geometry.voxels import EMPTY, Float, Int, find_slot, pack, table_length, unpack

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

FIRST_CAPACITY = 2048
UNFITTED = -1_000_000
SURFACE_COLUMNS = 8
"""mean (3) from the voxel's corner, normal (3), weight of the shape, variance of the normal's direction (rad2)."""


class VoxelMap:
    """Points (n, 3) of one frame in voxels of edge `voxel_size_m`.

    Parameters
    ----------
    voxel_size_m : edge of a voxel; also the farthest a neighbour is looked for.
    points_per_voxel : most points kept in a voxel; they keep a spacing of `voxel_size_m / sqrt(points_per_voxel)`.
    surface_radius_m : neighbours within it define the surface at a point; 0.75 voxels unless given.
    refit_after : surfaces are fitted again after this many calls of `insert`.
    """

    def __init__(
        self,
        voxel_size_m: float,
        points_per_voxel: int = 20,
        *,
        surface_radius_m: float | None = None,
        refit_after: int = 20,
    ) -> None:
        self.voxel_size_m = float(voxel_size_m)
        self.points_per_voxel = int(points_per_voxel)
        self.spacing_m = self.voxel_size_m / float(np.sqrt(points_per_voxel))
        self.surface_radius_m = min(surface_radius_m or 0.75 * self.voxel_size_m, self.voxel_size_m)
        self.refit_after = refit_after
        self.inserts = 0
        self.voxels = 0
        self.keys: I8 = np.full(table_length(FIRST_CAPACITY), EMPTY, np.int64)
        self.values: I4 = np.zeros(len(self.keys), np.int32)
        self.voxel_key, self.count, self.offset, self.surface, self.fitted = self._blank(FIRST_CAPACITY)

    def __len__(self) -> int:
        """Number of points."""
        return int(self.count[: self.voxels].sum())

    def insert(self, points_world: ArrayLike) -> int:
        """Add points (n, 3), m; those too close to stored ones, or not finite, are passed over. Returns how many stay."""
        points = np.ascontiguousarray(points_world, dtype=np.float64).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        self.inserts += 1
        self._reserve(self.voxels + len(points))
        voxels, added = _insert(
            points, self.voxel_size_m, self.spacing_m**2,
            self.keys, self.values, self.voxel_key, self.count, self.offset, self.fitted, self.voxels,
        )  # fmt: skip
        self.voxels = int(voxels)
        return int(added)

    def points(self) -> F8:
        """All points (n, 3), m, voxel by voxel in the order they came."""
        filled = np.arange(self.points_per_voxel) < self.count[: self.voxels, None]
        return (self._corners()[:, None, :] + self.offset[: self.voxels])[filled]

    def drop_far(self, center: ArrayLike, radius_m: float) -> None:
        """Forget voxels whose corner is farther than `radius_m` from `center` (3,)."""
        distance = np.linalg.norm(self._corners() - np.asarray(center, float), axis=1)
        kept = np.flatnonzero(distance <= radius_m)
        if len(kept) == self.voxels:
            return
        self._keep(
            kept,
            max(
                FIRST_CAPACITY,
                len(self.voxel_key) // 2 if 4 * len(kept) < len(self.voxel_key) else len(self.voxel_key),
            ),
        )

    def _corners(self) -> F8:
        return corners(self.voxel_key[: self.voxels], self.voxel_size_m)

    def _reserve(self, voxels: int) -> None:
        if voxels > len(self.voxel_key):
            self._keep(np.arange(self.voxels), max(voxels, 2 * len(self.voxel_key)))

    def _keep(self, kept: I8, capacity: int) -> None:
        """Move the kept voxels into arrays of the given capacity and rebuild the table."""
        voxel_key, count, offset, surface, fitted = self._blank(capacity)
        n = len(kept)
        voxel_key[:n], count[:n], fitted[:n] = self.voxel_key[kept], self.count[kept], self.fitted[kept]
        offset[:n], surface[:n] = self.offset[kept], self.surface[kept]
        self.voxel_key, self.count, self.offset, self.surface, self.fitted = (
            voxel_key,
            count,
            offset,
            surface,
            fitted,
        )
        self.voxels = n
        self.keys = np.full(table_length(capacity), EMPTY, np.int64)
        self.values = np.zeros(len(self.keys), np.int32)
        index_voxels(self.voxel_key, self.voxels, self.keys, self.values)

    def _blank(self, capacity: int) -> tuple[I8, I4, F4, F4, I4]:
        each = self.points_per_voxel
        return (
            np.zeros(capacity, np.int64),
            np.zeros(capacity, np.int32),
            np.zeros((capacity, each, 3), np.float32),
            np.zeros((capacity, each, SURFACE_COLUMNS), np.float32),
            np.full((capacity, each), UNFITTED, np.int32),
        )


def neighbour_steps() -> I8:
    """The 27 voxels around and including the middle one (27, 3), nearest first."""
    axis = np.arange(-1, 2)
    steps = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return steps[np.argsort((steps**2).sum(axis=1), kind="stable")].astype(np.int64)


STEPS = neighbour_steps()


@kernel
def corners(keys: I8, size: Float) -> F8:
    """Corner (n, 3) of the voxel of each key, m."""
    out = np.empty((len(keys), 3))
    for n in range(len(keys)):
        i, j, k = unpack(keys[n])
        out[n, 0], out[n, 1], out[n, 2] = i * size, j * size, k * size
    return out


@kernel
def index_voxels(voxel_key: I8, voxels: Int, keys: I8, values: I4) -> None:
    """Enter the first `voxels` keys into an empty hash table."""
    for v in range(voxels):
        slot = find_slot(keys, voxel_key[v])
        keys[slot] = voxel_key[v]
        values[slot] = v


@kernel
def _insert(
    points: F8, size: Float, spacing2: Float, keys: I8, values: I4, voxel_key: I8, count: I4, offset: F4, fitted: I4,
    voxels: Int,
) -> tuple[Int, Int]:  # fmt: skip
    most = offset.shape[1]
    added = 0
    for n in range(len(points)):
        i = np.int64(np.floor(points[n, 0] / size))
        j = np.int64(np.floor(points[n, 1] / size))
        k = np.int64(np.floor(points[n, 2] / size))
        key = pack(i, j, k)
        slot = find_slot(keys, key)
        if keys[slot] == EMPTY:
            keys[slot] = key
            values[slot] = voxels
            voxel_key[voxels] = key
            count[voxels] = 0
            voxels += 1
        v = values[slot]
        if count[v] >= most:
            continue
        x = np.float32(points[n, 0] - i * size)
        y = np.float32(points[n, 1] - j * size)
        z = np.float32(points[n, 2] - k * size)
        if _crowded(offset, v, count[v], x, y, z, spacing2):
            continue
        c = count[v]
        offset[v, c, 0], offset[v, c, 1], offset[v, c, 2] = x, y, z
        fitted[v, c] = UNFITTED
        count[v] = c + 1
        added += 1
    return voxels, added


@kernel
def _crowded(offset: F4, v: Int, count: Int, x: Float, y: Float, z: Float, spacing2: Float) -> bool:
    for c in range(count):
        dx, dy, dz = offset[v, c, 0] - x, offset[v, c, 1] - y, offset[v, c, 2] - z
        if dx * dx + dy * dy + dz * dz < spacing2:
            return True
    return False


@kernel
def nearest(
    x: Float,
    y: Float,
    z: Float,
    limit2: Float,
    size: Float,
    steps: I8,
    keys: I8,
    values: I4,
    count: I4,
    offset: F4,
) -> tuple[Int, Int, Float]:
    """Voxel, place in it and squared distance of the stored point nearest to (x, y, z); voxel -1 beyond `limit2`.

    Looks into the 27 voxels around, and skips those that cannot hold a nearer point.
    """
    i, j, k = np.int64(np.floor(x / size)), np.int64(np.floor(y / size)), np.int64(np.floor(z / size))
    fx, fy, fz = x - i * size, y - j * size, z - k * size
    best = limit2
    best_v: Int = -1
    best_c: Int = -1
    for s in range(27):
        di, dj, dk = steps[s, 0], steps[s, 1], steps[s, 2]
        if _gap2(fx, di, size) + _gap2(fy, dj, size) + _gap2(fz, dk, size) >= best:
            continue
        slot = find_slot(keys, pack(i + di, j + dj, k + dk))
        if keys[slot] == EMPTY:
            continue
        v = values[slot]
        px, py, pz = fx - di * size, fy - dj * size, fz - dk * size
        for c in range(count[v]):
            dx, dy, dz = offset[v, c, 0] - px, offset[v, c, 1] - py, offset[v, c, 2] - pz
            d2 = dx * dx + dy * dy + dz * dz
            if d2 < best:
                best, best_v, best_c = d2, np.int64(v), c
    return best_v, best_c, best


@kernel
def _gap2(inside: Float, step: Int, size: Float) -> Float:
    """Squared distance along one axis to the neighbouring voxel in direction `step`."""
    if step == 0:
        return 0.0
    gap = size - inside if step > 0 else inside
    return gap * gap


@kernel
def fit_surface(
    v: Int, c: Int, radius2: Float, size: Float, steps: I8, keys: I8, values: I4, count: I4, offset: F4,
    voxel_key: I8, surface: F4, a: F8, vectors: F8,
) -> None:  # fmt: skip
    """Fit the surface at point c of voxel v to the stored points within the radius; `a`, `vectors` are scratch."""
    i, j, k = unpack(voxel_key[v])
    x, y, z = float(offset[v, c, 0]), float(offset[v, c, 1]), float(offset[v, c, 2])
    # Sums in scalars and without a branch: half of the points are within, which no processor can guess.
    n = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for s in range(27):
        di, dj, dk = steps[s, 0], steps[s, 1], steps[s, 2]
        if _gap2(x, di, size) + _gap2(y, dj, size) + _gap2(z, dk, size) >= radius2:
            continue
        slot = find_slot(keys, pack(i + di, j + dj, k + dk))
        if keys[slot] == EMPTY:
            continue
        w = values[slot]
        px, py, pz = x - di * size, y - dj * size, z - dk * size
        for m in range(count[w]):
            dx, dy, dz = offset[w, m, 0] - px, offset[w, m, 1] - py, offset[w, m, 2] - pz
            within = 1.0 if dx * dx + dy * dy + dz * dz <= radius2 else 0.0
            n += within
            wx, wy, wz = within * dx, within * dy, within * dz
            sx, sy, sz = sx + wx, sy + wy, sz + wz
            xx, xy, xz = xx + wx * dx, xy + wx * dy, xz + wx * dz
            yy, yz, zz = yy + wy * dy, yz + wy * dz, zz + wz * dz
    sx, sy, sz = sx / n, sy / n, sz / n
    a[0, 0] = xx / n - sx * sx
    a[0, 1] = a[1, 0] = xy / n - sx * sy
    a[0, 2] = a[2, 0] = xz / n - sx * sz
    a[1, 1] = yy / n - sy * sy
    a[1, 2] = a[2, 1] = yz / n - sy * sz
    a[2, 2] = zz / n - sz * sz
    eigen_symmetric_3(a, vectors)
    surface[v, c, 0], surface[v, c, 1], surface[v, c, 2] = x + sx, y + sy, z + sz
    for r in range(3):
        surface[v, c, 3 + r] = vectors[r, 0]
    surface[v, c, 6] = shape_weight(a[0, 0], a[1, 1], a[2, 2], n)
    surface[v, c, 7] = max(a[0, 0], 0.0) / (n * max(a[1, 1], 1e-12))


MIN_NEIGHBOURS = 6
SURFACE_NOISE2 = 0.05**2
LEAST_WIDTH2 = 0.1**2


@kernel
def shape_weight(small: Float, middle: Float, large: Float, n: Float) -> Float:
    """Weight of a residual along the normal, from the eigenvalues (m2) of the n points around.

    1 on a clean plane and falling with its roughness; 0 where the points are too few or form a line, since a line of
    returns on a plane (one beam's ring) says nothing about the direction across it: range noise widens the ring along
    the beam, and the plane fitted to it would be that of the beam.
    """
    if n < MIN_NEIGHBOURS or middle < max(0.02 * large, LEAST_WIDTH2) or small > 0.2 * middle:
        return 0.0
    return SURFACE_NOISE2 / (SURFACE_NOISE2 + max(small, 0.0))
