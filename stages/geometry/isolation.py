"""Points that stand alone: fewer neighbours than a solid surface would give at their range.

The radius in which neighbours are counted grows with the range as the spacing of the beams does (the idea of dynamic
radius outlier removal, Charron et al. 2018), here with voxels of a few sizes instead of a search tree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import EMPTY, Int, find_slot, table_length

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

EDGE_SHARE = 0.7
"""Edge of a voxel over the radius; a point sees its own voxel and the 26 around, so between 0.7 and 1.4 radii."""
ALONGSIDE = 3
"""Points before and after a point, in their order, that are looked at before the voxels around it."""
INDEX_BITS = 19
INDEX_OFFSET = 1 << (INDEX_BITS - 1)


def isolated(
    x_m: F4, y_m: F4, z_m: F4, usable: B1, *, radius_m: float, radius_rad: float, least_neighbours: int
) -> B1:
    """Which usable points (n,) have fewer than `least_neighbours` others around them.

    Parameters
    ----------
    x_m, y_m, z_m : (n,) coordinates in the LiDAR frame, m.
    usable : (n,) points that count as neighbours; the others are never isolated.
    radius_m : radius close to the sensor.
    radius_rad : radius over range, from where that is more than `radius_m`.
    """
    per_m = radius_rad / radius_m
    keys = np.full(table_length(len(x_m)), EMPTY, np.int64)
    counts = np.zeros(len(keys), np.int32)
    level, slot = _fill(x_m, y_m, z_m, usable, radius_m * EDGE_SHARE, per_m, keys, counts)
    return _lonely(x_m, y_m, z_m, level, slot, radius_m * EDGE_SHARE, per_m, keys, counts, least_neighbours)


@kernel
def _level(ratio: float) -> int:
    """Smallest level with 2^level >= ratio."""
    level = 0
    while ratio > 1.0 and level < 15:
        ratio *= 0.5
        level += 1
    return level


@kernel
def _key(level: int, i: int, j: int, k: int) -> int:
    key = (level << INDEX_BITS) | ((i + INDEX_OFFSET) & ((1 << INDEX_BITS) - 1))
    key = (key << INDEX_BITS) | ((j + INDEX_OFFSET) & ((1 << INDEX_BITS) - 1))
    return (key << INDEX_BITS) | ((k + INDEX_OFFSET) & ((1 << INDEX_BITS) - 1))


@kernel
def _fill(
    x: F4, y: F4, z: F4, usable: B1, edge: float, per_m: float, keys: I8, counts: I4
) -> tuple[NDArray[np.int8], I4]:
    """Counts the points of each voxel; returns the level (n,), -1 for points left out, and the slot (n,) of each."""
    level, slot = np.full(len(x), -1, np.int8), np.zeros(len(x), np.int32)
    found: Int = 0
    last_key = EMPTY
    for n in range(len(x)):
        if not usable[n]:
            continue
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        at = _level(per_m * np.sqrt(px * px + py * py + pz * pz))
        per_edge = 1.0 / (edge * (1 << at))
        key = _key(
            at, int(np.floor(px * per_edge)), int(np.floor(py * per_edge)), int(np.floor(pz * per_edge))
        )
        if key != last_key:
            found = find_slot(keys, key)
            keys[found] = key
            last_key = key
        counts[found] += 1
        level[n], slot[n] = at, found
    return level, slot


@kernel
def _lonely(
    x: F4, y: F4, z: F4, level: NDArray[np.int8], slot: I4, edge: float, per_m: float, keys: I8, counts: I4, least: int
) -> B1:  # fmt: skip
    out = np.zeros(len(x), np.bool_)
    for n in range(len(x)):
        if level[n] < 0 or counts[slot[n]] > least:
            continue
        if _alongside(x, y, z, level, n, edge, least):
            continue
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        ratio = per_m * np.sqrt(px * px + py * py + pz * pz)
        at = int(level[n])
        seen = _around(px, py, pz, at, edge, keys, counts, least)
        size = per_m * edge * (1 << at)  # the voxel's edge in units of `ratio`
        if seen <= least and ratio + 2.0 * size > float(1 << at):
            seen += _around(px, py, pz, at + 1, edge, keys, counts, least)
        if seen <= least and at > 0 and ratio - 2.0 * size <= 0.5 * (1 << at):
            seen += _around(px, py, pz, at - 1, edge, keys, counts, least)
        out[n] = seen <= least
    return out


@kernel
def _alongside(x: F4, y: F4, z: F4, level: NDArray[np.int8], n: int, edge: float, enough: int) -> bool:
    """Whether the points next in order alone suffice: what `_around` would find, without a look into the table."""
    per_edge = 1.0 / (edge * (1 << level[n]))
    i, j, k = int(np.floor(x[n] * per_edge)), int(np.floor(y[n] * per_edge)), int(np.floor(z[n] * per_edge))
    seen = 1
    for m in range(max(n - ALONGSIDE, 0), min(n + ALONGSIDE + 1, len(x))):
        if m == n or level[m] != level[n]:
            continue
        if (
            abs(int(np.floor(x[m] * per_edge)) - i) <= 1
            and abs(int(np.floor(y[m] * per_edge)) - j) <= 1
            and abs(int(np.floor(z[m] * per_edge)) - k) <= 1
        ):
            seen += 1
            if seen > enough:
                return True
    return False


@kernel
def _around(
    px: float, py: float, pz: float, level: int, edge: float, keys: I8, counts: I4, enough: int
) -> int:
    """Points in the 27 voxels of one level around a place; stops counting when there are more than `enough`."""
    per_edge = 1.0 / (edge * (1 << level))
    i, j, k = int(np.floor(px * per_edge)), int(np.floor(py * per_edge)), int(np.floor(pz * per_edge))
    seen = 0
    for a in range(27):  # 0, 1, -1 on each axis: the voxels nearby come first
        di, dj, dk = (a // 3 % 3 + 1) % 3 - 1, (a % 3 + 1) % 3 - 1, (a // 9 + 1) % 3 - 1
        found = find_slot(keys, _key(level, i + di, j + dj, k + dk))
        if keys[found] != EMPTY:
            seen += int(counts[found])
            if seen > enough:
                return seen
    return seen
