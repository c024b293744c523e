"""Returns and rays of one scan, marked in a field of voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.clean.field import (
    BLOCKED,
    HIT,
    I4,
    I8,
    MET,
    MOVED,
    PASSED,
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
    x: F4, y: F4, z: F4, classes: U1, tracked: NDArray[np.bool_], T: F8, reach_m: float, voxel_m: float, start: Int,
    keys: I8, rows: I4, order: I8, count: I8, now: U1,
) -> int:  # fmt: skip
    """Mark the voxels of the returns from number `start` on, and those around them as blocked for this bin.

    Returns len(x), or the number of the return at which the field was full.
    """
    per_m = 1.0 / voxel_m
    last: Int = EMPTY
    row: Int = 0
    for n in range(start, len(x)):
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        i, j, k = voxel_at(px, py, pz, T, per_m)
        key = brick_key(i, j, k)
        if key != last:
            row = row_made(keys, rows, order, count, key)
            last = key
            if row < 0:
                return n
        q = inner(i, j, k)
        if classes[n] != GROUND:
            now[row, q] |= (HIT | MOVED) if tracked[n] else HIT
        if now[row, q] & MET or px * px + py * py + pz * pz > reach_m * reach_m:
            continue
        if not _block(i, j, k, row, keys, rows, order, count, now):
            return n
        now[row, q] |= MET
    return len(x)


@kernel
def _block(
    i: Int, j: Int, k: Int, row: Int, keys: I8, rows: I4, order: I8, count: I8, now: U1
) -> bool:  # fmt: skip
    """Block a voxel and the 26 around it for this bin; False when the field is full."""
    u, v, w = i & 7, j & 7, k & 7
    if 0 < u < 7 and 0 < v < 7 and 0 < w < 7:
        for a in range(u - 1, u + 2):
            for b in range(v - 1, v + 2):
                at = (a << 6) | (b << 3) | w
                now[row, at - 1] |= BLOCKED
                now[row, at] |= BLOCKED
                now[row, at + 1] |= BLOCKED
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
                now[at_row, inner(a, b, c)] |= BLOCKED
    return True


@kernel
def walk(
    x: F4, y: F4, z: F4, since_m: F4, clear_m: F4, T: F8, reach_m: float, voxel_m: float, start: Int,
    keys: I8, rows: I4, order: I8, count: I8, now: U1,
) -> int:  # fmt: skip
    """Mark every voxel that a ray passes between `since_m` and `clear_m` (n,) from the sensor and that is not blocked.

    Voxel by voxel along the ray (Amanatides and Woo 1987). Returns len(x), or the number of the ray at which the field
    was full; that ray may be walked again.
    """
    per_m = 1.0 / voxel_m
    for n in range(start, len(x)):
        end = min(float(clear_m[n]), reach_m)
        t = max(float(since_m[n]), NEAREST_M)
        if not end > t:
            continue
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        r = np.sqrt(px * px + py * py + pz * pz)
        dx = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz) / r
        dy = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz) / r
        dz = (T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz) / r
        i = np.int64(np.floor((T[0, 3] + dx * t) * per_m))
        j = np.int64(np.floor((T[1, 3] + dy * t) * per_m))
        k = np.int64(np.floor((T[2, 3] + dz * t) * per_m))
        step_i, enter_i, to_i, along_i = _axis(T[0, 3], dx, i, voxel_m)
        step_j, enter_j, to_j, along_j = _axis(T[1, 3], dy, j, voxel_m)
        step_k, enter_k, to_k, along_k = _axis(T[2, 3], dz, k, voxel_m)
        row: Int = -1
        while t < end:
            if row < 0:
                row = row_made(keys, rows, order, count, brick_key(i, j, k))
                if row < 0:
                    return n
            q = inner(i, j, k)
            if now[row, q] & (BLOCKED | PASSED) == 0:
                now[row, q] |= PASSED
            if to_i < to_j and to_i < to_k:
                t, to_i, i = to_i, to_i + along_i, i + step_i
                crossed = i & 7 == enter_i
            elif to_j < to_k:
                t, to_j, j = to_j, to_j + along_j, j + step_j
                crossed = j & 7 == enter_j
            else:
                t, to_k, k = to_k, to_k + along_k, k + step_k
                crossed = k & 7 == enter_k
            if crossed:
                row = -1
    return len(x)


@kernel
def _axis(origin: float, direction: float, index: Int, voxel_m: float) -> tuple[int, int, float, float]:
    """Along one axis: step of the index, place in a brick at which it is entered, distance to the first wall, and between walls."""
    if direction > 0.0:
        return 1, 0, ((index + 1) * voxel_m - origin) / direction, voxel_m / direction
    if direction < 0.0:
        return -1, 7, (index * voxel_m - origin) / direction, -voxel_m / direction
    return 0, -1, np.inf, np.inf
