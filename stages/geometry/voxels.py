"""Voxels: integer keys of cubes, first-come downsampling, and a hash table that kernels can use.

A key packs the three voxel indices (21 bits each, so 2 million voxels a side) into one int64; it is never negative.
The table is open-addressed with linear probing: arrays `keys` (EMPTY where free) and `values`, a power of two long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.stages.geometry.kernels import kernel

Int = int | np.integer[Any]
"""A whole number inside a kernel, where numpy scalars pass for Python's."""
Float = float | np.floating[Any]

EMPTY = -1
INDEX_BITS = 21
INDEX_OFFSET = 1 << (INDEX_BITS - 1)
INDEX_MASK = (1 << INDEX_BITS) - 1
_MIX = np.uint64(0x9E3779B97F4A7C15)
_HIGH = np.uint64(32)


def voxel_keys(points: ArrayLike, voxel_size_m: float) -> NDArray[np.int64]:
    """Key (n,) of the voxel each point (n, 3), m, lies in; -1 for points that are not finite."""
    return _keys(_rows(points), 1.0 / voxel_size_m)


def downsample(points: ArrayLike, voxel_size_m: float) -> NDArray[np.int64]:
    """Indices (m,) of the first point of every voxel, increasing; points (n, 3), m, that are not finite are left out."""
    rows = _rows(points)
    return _first_per_voxel(rows, 1.0 / voxel_size_m, table_length(len(rows)))


def table_length(entries: int) -> int:
    """Length of a hash table for this many entries: a power of two that stays at most half full."""
    return 1 << max(4, int(2 * entries - 1).bit_length())


def _rows(points: ArrayLike) -> NDArray[np.floating]:
    rows = np.asarray(points)
    if rows.dtype not in (np.float32, np.float64):
        rows = rows.astype(np.float64)
    return rows.reshape(-1, 3)


@kernel
def pack(i: Int, j: Int, k: Int) -> int:
    """Key of the voxel with indices (i, j, k)."""
    i, j, k = i + INDEX_OFFSET, j + INDEX_OFFSET, k + INDEX_OFFSET
    return ((i & INDEX_MASK) << (2 * INDEX_BITS)) | ((j & INDEX_MASK) << INDEX_BITS) | (k & INDEX_MASK)


@kernel
def unpack(key: Int) -> tuple[int, int, int]:
    """Indices of the voxel with this key."""
    i = (key >> (2 * INDEX_BITS)) & INDEX_MASK
    j = (key >> INDEX_BITS) & INDEX_MASK
    return i - INDEX_OFFSET, j - INDEX_OFFSET, (key & INDEX_MASK) - INDEX_OFFSET


@kernel
def find_slot(keys: NDArray[np.int64], key: Int) -> Int:
    """Slot that holds `key`, or the free slot where it belongs."""
    mask = len(keys) - 1
    slot: Int = np.int64((np.uint64(key) * _MIX) >> _HIGH) & mask
    while keys[slot] != EMPTY and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
def key_of(x: Float, y: Float, z: Float, per_m: Float) -> int:
    """Key of the voxel that holds a point; EMPTY when it is not finite."""
    if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
        return EMPTY
    return pack(np.int64(np.floor(x * per_m)), np.int64(np.floor(y * per_m)), np.int64(np.floor(z * per_m)))


@kernel
def _keys(points: NDArray[np.floating], per_m: Float) -> NDArray[np.int64]:
    out = np.empty(len(points), np.int64)
    for n in range(len(points)):
        out[n] = key_of(float(points[n, 0]), float(points[n, 1]), float(points[n, 2]), per_m)
    return out


@kernel
def _first_per_voxel(points: NDArray[np.floating], per_m: Float, length: Int) -> NDArray[np.int64]:
    keys = np.full(length, EMPTY, np.int64)
    out = np.empty(len(points), np.int64)
    found = 0
    for n in range(len(points)):
        key = key_of(float(points[n, 0]), float(points[n, 1]), float(points[n, 2]), per_m)
        if key == EMPTY:
            continue
        slot = find_slot(keys, key)
        if keys[slot] == EMPTY:
            keys[slot] = key
            out[found] = n
            found += 1
    return out[:found].copy()
