"""The field of voxels that a chunk's rays pass: bricks of 8 x 8 x 8 voxels in a hash table, counts in each."""

from __future__ import annotations

from typing import Any

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

HIT, MOVED, BLOCKED, MET, PASSED = 1, 2, 4, 8, 16
"""What the present bin says of a voxel: a return lies in it, one of what is tracked, a return lies in or beside it, those
beside it are blocked already, a ray passes."""
HITS, TRACKED, BEFORE, BETWEEN, AFTER = range(5)
"""Layers of a brick: counts of bins as in `schemas.clean.Rays`."""
LAYERS = 5


class Field:
    """Bricks by key. `now` (bricks, 512) holds flags of the present bin, `counts` (bricks, LAYERS, 512) those of all before;
    they grow when full."""

    def __init__(self) -> None:
        self.count = np.zeros(1, np.int64)
        self.order = np.empty(FIRST_BRICKS, np.int64)
        self.now = np.zeros((FIRST_BRICKS, BRICK_VOXELS), np.uint8)
        self.counts = np.zeros((FIRST_BRICKS, LAYERS, BRICK_VOXELS), np.uint8)
        self.keys, self.rows = brick_table(self.order[:0], FIRST_BRICKS)

    def grow(self) -> None:
        """Twice the room."""
        more = 2 * len(self.order)
        n = int(self.count[0])
        self.order, self.now, self.counts = (_roomy(a, n, more) for a in (self.order, self.now, self.counts))
        self.keys, self.rows = brick_table(self.bricks, more)

    def settle(self) -> None:
        """Count what the present bin says, and begin the next."""
        n = int(self.count[0])
        settle(self.now[:n], self.now[:n].view(np.uint64), self.counts[:n])

    @property
    def bricks(self) -> I8:
        """Keys (n,) in the order in which they were met."""
        return self.order[: int(self.count[0])]


def _roomy(array: NDArray[Any], used: int, room: int) -> NDArray[Any]:
    out = np.zeros((room, *array.shape[1:]), array.dtype)
    out[:used] = array[:used]
    return out


@kernel
def settle(now: U1, eights: NDArray[np.uint64], counts: NDArray[np.uint8]) -> None:
    """Add a bin's flags (bricks, 512) to the counts and wipe them; `eights` (bricks, 64) are the same flags, eight at once."""
    for n in range(len(now)):
        for e in range(eights.shape[1]):
            if eights[n, e] == 0:
                continue
            for q in range(8 * e, 8 * e + 8):
                if now[n, q]:
                    _count(now[n, q], counts[n], q)
            eights[n, e] = 0


@kernel
def _count(said: Int, brick: U1, q: int) -> None:
    if said & HIT:
        if brick[HITS, q] > 0:
            brick[BETWEEN, q] = min(SATURATED, np.int64(brick[BETWEEN, q]) + brick[AFTER, q])
            brick[AFTER, q] = 0
        if brick[HITS, q] < SATURATED:
            brick[HITS, q] += 1
        if said & MOVED and brick[TRACKED, q] < SATURATED:
            brick[TRACKED, q] += 1
    if said & PASSED and not said & BLOCKED:
        counted = AFTER if brick[HITS, q] > 0 else BEFORE
        if brick[counted, q] < SATURATED:
            brick[counted, q] += 1


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
