"""The field of voxels that a chunk's rays pass: bricks of 8 x 8 x 8 voxels in a hash table, counts in each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import BRICK_VOXELS
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import EMPTY, Int, find_slot, pack, table_length

I4 = NDArray[np.int32]
I8 = NDArray[np.int64]
U1 = NDArray[np.uint8]

FIRST_BRICKS = 1 << 12
SATURATED = 255

BLOCKED, PASSED, HIT, TRACKED_HIT, HITS, TRACKED, BEFORE, BETWEEN, AFTER = range(9)
"""Layers of a brick: bins that last blocked, passed and hit a voxel, the last also of what is tracked; counts of bins as in
`schemas.clean.Rays`."""
LAYERS = 9


class Field:
    """Bricks by key. `voxels` (bricks, LAYERS, 512) holds stamps and counts; it grows when `full`."""

    def __init__(self) -> None:
        self.count = np.zeros(1, np.int64)
        self.order = np.empty(FIRST_BRICKS, np.int64)
        self.voxels = np.zeros((FIRST_BRICKS, LAYERS, BRICK_VOXELS), np.uint8)
        self.keys, self.rows = brick_table(self.order[:0], FIRST_BRICKS)

    def grow(self) -> None:
        """Twice the room."""
        more = 2 * len(self.order)
        n = int(self.count[0])
        order, voxels = np.empty(more, np.int64), np.zeros((more, *self.voxels.shape[1:]), np.uint8)
        order[:n], voxels[:n] = self.order[:n], self.voxels[:n]
        self.order, self.voxels = order, voxels
        self.keys, self.rows = brick_table(self.bricks, more)

    def stamp(self, bin_: int) -> int:
        """Stamp, 1 to 255, of a bin, counted from 1; stamps that come round again are wiped first."""
        if bin_ > 1 and bin_ % SATURATED == 1:
            self.voxels[:, : TRACKED_HIT + 1] = 0
        return 1 + (bin_ - 1) % SATURATED

    @property
    def bricks(self) -> I8:
        """Keys (n,) in the order in which they were met."""
        return self.order[: int(self.count[0])]


def brick_table(bricks: I8, room: int) -> tuple[I8, I4]:
    """Hash table (keys, rows) from each brick to its number, with room for so many."""
    keys = np.full(table_length(max(room, 1)), EMPTY, np.int64)
    rows = np.zeros(len(keys), np.int32)
    insert_all(keys, rows, bricks)
    return keys, rows


@kernel
def insert_all(keys: I8, rows: I4, bricks: I8) -> None:
    """Row of every brick into an empty table."""
    for n in range(len(bricks)):
        slot = find_slot(keys, bricks[n])
        keys[slot] = bricks[n]
        rows[slot] = n


@kernel
def row_of(keys: I8, rows: I4, key: Int) -> Int:
    """Row of a brick, -1 when it is not there."""
    slot = find_slot(keys, key)
    return np.int64(rows[slot]) if keys[slot] != EMPTY else np.int64(-1)


@kernel
def row_made(keys: I8, rows: I4, order: I8, count: I8, key: Int) -> Int:
    """Row of a brick, made if need be; -1 when there is no room for it."""
    slot = find_slot(keys, key)
    if keys[slot] != EMPTY:
        return np.int64(rows[slot])
    n = count[0]
    if n >= len(order):
        return np.int64(-1)
    keys[slot], rows[slot], order[n] = key, n, key
    count[0] = n + 1
    return np.int64(n)


@kernel
def voxel_at(x: float, y: float, z: float, T: F8, per_m: float) -> tuple[Int, Int, Int]:
    """Indices of the voxel that holds a point, given in another frame and T (4, 4) from there to the map."""
    i = np.int64(np.floor((T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) * per_m))
    j = np.int64(np.floor((T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) * per_m))
    k = np.int64(np.floor((T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]) * per_m))
    return i, j, k


@kernel
def brick_key(i: Int, j: Int, k: Int) -> Int:
    """Key of the brick that holds a voxel."""
    return pack(i >> 3, j >> 3, k >> 3)


@kernel
def inner(i: Int, j: Int, k: Int) -> Int:
    """Place of a voxel in its brick."""
    return ((i & 7) << 6) | ((j & 7) << 3) | (k & 7)
