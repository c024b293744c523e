"""Returns and rays of one scan, marked in a field of voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import BRICK_VOXELS
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
from scanloom.stages.geometry.voxels import EMPTY, Int, pack

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
GROUND, DYNAMIC = int(PointClass.GROUND), int(PointClass.DYNAMIC)
NEAREST_M = 1.0
"""Rays say nothing of what is nearer."""
UNITS_PER_M, NEVER_M = float(1 << 40), float(1 << 20)
"""Lengths along rays are whole numbers of these; no ray reaches this far, m."""
NEVER = np.int64(1 << 60)
STEP_I, STEP_J, STEP_K = ((1 << 24) | 64, (1 << 20) | 8, (1 << 16) | 1)
IN_BRICK, LEFT = BRICK_VOXELS - 1, (8 << 24) | (8 << 20) | (8 << 16)


@kernel
def counted(x: F4, y: F4, z: F4, classes: U1, tracked: B1, seen: B1) -> tuple[F4, F4, F4, U1, B1]:
    """x, y, z, class and whether it moved (m,) of the returns whose class is `seen` (classes,)."""
    a, b, c = (
        np.empty(len(x) + 1, np.float32),
        np.empty(len(x) + 1, np.float32),
        np.empty(len(x) + 1, np.float32),
    )
    of, moved, kept = np.empty(len(x) + 1, np.uint8), np.empty(len(x) + 1, np.bool_), 0
    for n in range(len(x)):
        a[kept], b[kept], c[kept], of[kept] = x[n], y[n], z[n], classes[n]
        moved[kept] = tracked[n] | (classes[n] == DYNAMIC)
        kept += int(seen[classes[n]])
    return a[:kept].copy(), b[:kept].copy(), c[:kept].copy(), of[:kept].copy(), moved[:kept].copy()


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
    for bi in range((i - 1) >> 3, ((i + 1) >> 3) + 1):
        for bj in range((j - 1) >> 3, ((j + 1) >> 3) + 1):
            for bk in range((k - 1) >> 3, ((k + 1) >> 3) + 1):
                beside = row_made(keys, rows, order, count, pack(bi, bj, bk))
                if beside < 0:
                    return False
                for a in range(max(i - 1, bi << 3), min(i + 1, (bi << 3) + 7) + 1):
                    for b in range(max(j - 1, bj << 3), min(j + 1, (bj << 3) + 7) + 1):
                        for c in range(max(k - 1, bk << 3), min(k + 1, (bk << 3) + 7) + 1):
                            now[beside, inner(a, b, c)] |= BLOCKED
    return True


@kernel
def walk(
    x: F4, y: F4, z: F4, since_m: F4, clear_m: F4, T: F8, reach_m: float, voxel_m: float, start: Int,
    keys: I8, rows: I4, order: I8, count: I8, now: U1,
) -> int:  # fmt: skip
    """Mark every voxel that a ray passes between `since_m` and `clear_m` (n,) from the sensor.

    Voxel by voxel along the ray (Amanatides and Woo 1987), in whole numbers, which are quicker to compare. Returns len(x), or the number of the ray at which the field was full; that ray
    may be walked again.
    """
    per_m = 1.0 / voxel_m
    flags = now.reshape(-1)
    for n in range(start, len(x)):
        end_m = min(float(clear_m[n]), reach_m)
        t_m = max(float(since_m[n]), NEAREST_M)
        if not end_m > t_m:
            continue
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        r = np.sqrt(px * px + py * py + pz * pz)
        dx = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz) / r
        dy = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz) / r
        dz = (T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz) / r
        i: Int = np.int64(np.floor((T[0, 3] + dx * t_m) * per_m))
        j: Int = np.int64(np.floor((T[1, 3] + dy * t_m) * per_m))
        k: Int = np.int64(np.floor((T[2, 3] + dz * t_m) * per_m))
        step_i, flip_i, to_i, along_i = _axis(T[0, 3], dx, i, voxel_m)
        step_j, flip_j, to_j, along_j = _axis(T[1, 3], dy, j, voxel_m)
        step_k, flip_k, to_k, along_k = _axis(T[2, 3], dz, k, voxel_m)
        flip = (flip_i << 6) | (flip_j << 3) | flip_k
        at = _place((i & 7) ^ flip_i, (j & 7) ^ flip_j, (k & 7) ^ flip_k)
        i, j, k = i >> 3, j >> 3, k >> 3
        t: Int = np.int64(t_m * UNITS_PER_M)
        end = np.int64(end_m * UNITS_PER_M)
        first: Int = -1
        while t < end:
            if first < 0:
                first = row_made(keys, rows, order, count, pack(i, j, k)) * BRICK_VOXELS
                if first < 0:
                    return n
            flags[np.uint64(first + ((at & IN_BRICK) ^ flip))] |= PASSED
            if to_i < to_j and to_i < to_k:
                t, to_i, at = to_i, to_i + along_i, at + STEP_I
                if at & LEFT:
                    first, i, at = -1, i + step_i, at - 8 * STEP_I
            elif to_j < to_k:
                t, to_j, at = to_j, to_j + along_j, at + STEP_J
                if at & LEFT:
                    first, j, at = -1, j + step_j, at - 8 * STEP_J
            else:
                t, to_k, at = to_k, to_k + along_k, at + STEP_K
                if at & LEFT:
                    first, k, at = -1, k + step_k, at - 8 * STEP_K
    return len(x)


@kernel
def _place(u: Int, v: Int, w: Int) -> Int:
    """A place in a brick, counted the way the ray goes: its number, and above that each axis with a bit to spare, in which
    it shows that the brick is left."""
    return u * STEP_I + v * STEP_J + w * STEP_K


@kernel
def _axis(origin: float, direction: float, index: Int, voxel_m: float) -> tuple[Int, Int, Int, Int]:
    """Along one axis: step of the index, what turns a place in a brick into one counted the way the ray goes, distance to
    the first wall, and between walls."""
    if direction > 0.0:
        return 1, 0, _units(((index + 1) * voxel_m - origin) / direction), _units(voxel_m / direction)
    if direction < 0.0:
        return -1, 7, _units((index * voxel_m - origin) / direction), _units(-voxel_m / direction)
    return 0, 0, NEVER, NEVER


@kernel
def _units(length_m: float) -> Int:
    """A length in whole numbers."""
    return np.int64(min(length_m, NEVER_M) * UNITS_PER_M)
