"""A polar grid around the vehicle, finer near it: cells of sectors by bins of distance, and what lies in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I2 = NDArray[np.int16]

ZERO, HALF, ONE, TWICE, THREE = (np.float32(c) for c in (0.0, 0.5, 1.0, 2.0, 3.0))
SECTORS = 180
NEAR_M, MIDDLE_M, FAR_M = 20.0, 50.0, 120.0
BINS = 40 + 30 + 35
"""Cells of 0.5 m up to 20 m, of 1 m up to 50 m, of 2 m up to 120 m."""


NEAR, MIDDLE, FAR, NEAR_BINS, MIDDLE_BINS = (np.float32(c) for c in (NEAR_M, MIDDLE_M, FAR_M, 40, 70))
SECTORS_PER_TURN, TINY = np.float32(0.25 * SECTORS), np.float32(1e-30)
LAST_SECTOR, LAST_BIN, BINS_OF_SECTOR, NOWHERE = (np.int32(c) for c in (SECTORS - 1, BINS - 1, BINS, -1))


@kernel
def center(b: int) -> float:
    if b < 40:
        return 0.5 * b + 0.25
    if b < 70:
        return NEAR_M + (b - 40) + 0.5
    return MIDDLE_M + 2.0 * (b - 70) + 1.0


@kernel
def direction(s: int) -> tuple[float, float]:
    """Unit vector of the middle of a sector."""
    turn = (s + 0.5) * 4.0 / SECTORS
    y = turn - 1.0 if turn < 2.0 else 3.0 - turn
    x = 1.0 - abs(y) if turn < 2.0 else abs(y) - 1.0
    norm = np.sqrt(x * x + y * y)
    return x / norm, y / norm


@kernel
def levelled(x: F4, y: F4, z: F4, usable: B1, R: F8) -> tuple[I2, F4, F4, F4]:
    """For each point (n,) its cell, sector BINS + bin, -1 if it has none, and its coordinates turned by R (3, 3), m.

    A sector is told by the angle of a diamond, which rises with the azimuth and needs no arc tangent.
    """
    cell = np.empty(len(x), np.int16)
    forward, left, up = (
        np.empty(len(x), np.float32),
        np.empty(len(x), np.float32),
        np.empty(len(x), np.float32),
    )
    a, b, c = np.float32(R[0, 0]), np.float32(R[0, 1]), np.float32(R[0, 2])
    d, e, f = np.float32(R[1, 0]), np.float32(R[1, 1]), np.float32(R[1, 2])
    g, h, j = np.float32(R[2, 0]), np.float32(R[2, 1]), np.float32(R[2, 2])
    for i in range(len(x)):  # all of it, and no branch, so that the compiler takes several points at once
        u, v = a * x[i] + b * y[i] + c * z[i], d * x[i] + e * y[i] + f * z[i]
        forward[i], left[i], up[i] = u, v, g * x[i] + h * y[i] + j * z[i]
        r, norm = np.sqrt(u * u + v * v), abs(u) + abs(v)
        p = v / max(norm, TINY)
        turn = ONE + p if u >= ZERO else THREE - p  # from -y in [0, 4]
        sector = min(np.int32(turn * SECTORS_PER_TURN), LAST_SECTOR)
        near, middle, far = r * TWICE, NEAR_BINS + (r - NEAR), MIDDLE_BINS + (r - MIDDLE) * HALF
        bins = min(np.int32(near if r < NEAR else (middle if r < MIDDLE else far)), LAST_BIN)
        cell[i] = sector * BINS_OF_SECTOR + bins if usable[i] & (r < FAR) else NOWHERE
    return cell, forward, left, up


@kernel
def extent(cell: I2, up: F4) -> tuple[F8, F8]:
    """Lowest and highest points (SECTORS, BINS) of each cell, m; inf and -inf if there are none."""
    lowest, highest = np.full(SECTORS * BINS, np.inf), np.full(SECTORS * BINS, -np.inf)
    for i in range(len(cell)):
        if cell[i] >= 0:
            lowest[cell[i]] = min(lowest[cell[i]], up[i])
            highest[cell[i]] = max(highest[cell[i]], up[i])
    return lowest.reshape(SECTORS, BINS), highest.reshape(SECTORS, BINS)
