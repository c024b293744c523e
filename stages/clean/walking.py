"""Returns and rays of one scan, marked in a field of voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.clean.field import (
    AFTER,
    BEFORE,
    BETWEEN,
    BLOCKED,
    HIT,
    HITS,
    I4,
    I8,
    PASSED,
    SATURATED,
    TRACKED,
    TRACKED_HIT,
    U1,
    brick_key,
    inner,
    row_made,
    voxel_at,
)
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import EMPTY, Int

F4 = NDArray[np.float32]
GROUND = int(PointClass.GROUND)
NEAREST_M = 1.0
"""Rays say nothing of what is nearer."""


@kernel
def mark_hits(
    x: F4, y: F4, z: F4, classes: U1, tracked: NDArray[np.bool_], T: F8, bin_: Int, reach_m: float, voxel_m: float, start: Int,
    keys: I8, rows: I4, order: I8, count: I8, voxels: NDArray[np.uint8],
) -> int:  # fmt: skip
    """Mark the voxels of the returns from number `start` on, and those around them as blocked for this bin.

    Returns len(x), or the number of the return at which the field was full.
    """
    per_m = 1.0 / voxel_m
    for n in range(start, len(x)):
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        i, j, k = voxel_at(px, py, pz, T, per_m)
        row = row_made(keys, rows, order, count, brick_key(i, j, k))
        if row < 0:
            return n
        brick = voxels[row]
        q = inner(i, j, k)
        if classes[n] != GROUND and brick[HIT, q] != bin_:
            brick[HIT, q] = bin_
            if brick[HITS, q] > 0:
                brick[BETWEEN, q] = min(SATURATED, np.int64(brick[BETWEEN, q]) + brick[AFTER, q])
                brick[AFTER, q] = 0
            if brick[HITS, q] < SATURATED:
                brick[HITS, q] += 1
        if tracked[n] and classes[n] != GROUND and brick[TRACKED_HIT, q] != bin_:
            brick[TRACKED_HIT, q] = bin_
            if brick[TRACKED, q] < SATURATED:
                brick[TRACKED, q] += 1
        if px * px + py * py + pz * pz > reach_m * reach_m:
            continue
        if not _block(i, j, k, bin_, row, keys, rows, order, count, voxels):
            return n
    return len(x)


@kernel
def _block(
    i: Int, j: Int, k: Int, bin_: Int, row: Int, keys: I8, rows: I4, order: I8, count: I8, voxels: NDArray[np.uint8]
) -> bool:  # fmt: skip
    """Block a voxel and the 26 around it for this bin; False when the field is full."""
    u, v, w = i & 7, j & 7, k & 7
    if 0 < u < 7 and 0 < v < 7 and 0 < w < 7:
        for a in range(u - 1, u + 2):
            for b in range(v - 1, v + 2):
                at = (a << 6) | (b << 3) | w
                voxels[row, BLOCKED, at - 1] = bin_
                voxels[row, BLOCKED, at] = bin_
                voxels[row, BLOCKED, at + 1] = bin_
        return True
    last: Int = EMPTY
    at_row: Int = row
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                key = brick_key(a, b, c)
                if key != last:
                    at_row = row_made(keys, rows, order, count, key)
                    last = key
                    if at_row < 0:
                        return False
                voxels[at_row, BLOCKED, inner(a, b, c)] = bin_
    return True


@kernel
def walk(
    x: F4, y: F4, z: F4, clear_m: F4, T: F8, bin_: Int, reach_m: float, voxel_m: float, start: Int,
    keys: I8, rows: I4, order: I8, count: I8, voxels: NDArray[np.uint8],
) -> int:  # fmt: skip
    """Count this bin in every voxel that a ray passes up to `clear_m` (n,) from the sensor and that is not blocked.

    Voxel by voxel along the ray (Amanatides and Woo 1987). Returns len(x), or the number of the ray at which the field
    was full; that ray may be walked again.
    """
    per_m = 1.0 / voxel_m
    for n in range(start, len(x)):
        end = min(float(clear_m[n]), reach_m)
        if not end > NEAREST_M:
            continue
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        r = np.sqrt(px * px + py * py + pz * pz)
        dx = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz) / r
        dy = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz) / r
        dz = (T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz) / r
        i = np.int64(np.floor((T[0, 3] + dx * NEAREST_M) * per_m))
        j = np.int64(np.floor((T[1, 3] + dy * NEAREST_M) * per_m))
        k = np.int64(np.floor((T[2, 3] + dz * NEAREST_M) * per_m))
        step_i, to_i, along_i = _axis(T[0, 3], dx, i, voxel_m)
        step_j, to_j, along_j = _axis(T[1, 3], dy, j, voxel_m)
        step_k, to_k, along_k = _axis(T[2, 3], dz, k, voxel_m)
        last: Int = EMPTY
        row: Int = 0
        t = NEAREST_M
        while t < end:
            key = brick_key(i, j, k)
            if key != last:
                row = row_made(keys, rows, order, count, key)
                last = key
                if row < 0:
                    return n
            q = inner(i, j, k)
            if voxels[row, BLOCKED, q] != bin_ and voxels[row, PASSED, q] != bin_:
                voxels[row, PASSED, q] = bin_
                counted = AFTER if voxels[row, HITS, q] > 0 else BEFORE
                if voxels[row, counted, q] < SATURATED:
                    voxels[row, counted, q] += 1
            if to_i < to_j and to_i < to_k:
                t, to_i, i = to_i, to_i + along_i, i + step_i
            elif to_j < to_k:
                t, to_j, j = to_j, to_j + along_j, j + step_j
            else:
                t, to_k, k = to_k, to_k + along_k, k + step_k
    return len(x)


@kernel
def _axis(origin: float, direction: float, index: Int, voxel_m: float) -> tuple[int, float, float]:
    """Step of the index, distance to the first wall, distance between walls along one axis."""
    if direction > 0.0:
        return 1, ((index + 1) * voxel_m - origin) / direction, voxel_m / direction
    if direction < 0.0:
        return -1, (index * voxel_m - origin) / direction, -voxel_m / direction
    return 0, np.inf, np.inf
