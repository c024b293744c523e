"""A polar grid around the vehicle, finer near it: cells of sectors by bins of distance, and what lies in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I2 = NDArray[np.int16]

SECTORS = 180
NEAR_M, MIDDLE_M, FAR_M = 20.0, 50.0, 120.0
BINS = 40 + 30 + 35
"""Cells of 0.5 m up to 20 m, of 1 m up to 50 m, of 2 m up to 120 m."""


@kernel
def bin_of(r: float) -> int:
    if r < NEAR_M:
        return int(r * 2.0)
    if r < MIDDLE_M:
        return 40 + int(r - NEAR_M)
    return min(70 + int((r - MIDDLE_M) * 0.5), BINS - 1)


@kernel
def center(b: int) -> float:
    if b < 40:
        return 0.5 * b + 0.25
    if b < 70:
        return NEAR_M + (b - 40) + 0.5
    return MIDDLE_M + 2.0 * (b - 70) + 1.0


@kernel
def sector_of(x: float, y: float) -> int:
    """Sector by the angle of a diamond, which rises with the azimuth and needs no arc tangent."""
    norm = abs(x) + abs(y)
    if norm == 0.0:
        return 0
    p = y / norm
    turn = 1.0 + p if x >= 0.0 else 3.0 - p  # from -y in [0, 4)
    return min(int(turn * (0.25 * SECTORS)), SECTORS - 1)


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
    """For each point (n,) its cell, sector BINS + bin, -1 if it has none, and its coordinates turned by R (3, 3), m."""
    cell = np.full(len(x), -1, np.int16)
    forward, left, up = (
        np.empty(len(x), np.float32),
        np.empty(len(x), np.float32),
        np.empty(len(x), np.float32),
    )
    for i in range(len(x)):
        if not usable[i]:
            continue
        u = R[0, 0] * x[i] + R[0, 1] * y[i] + R[0, 2] * z[i]
        v = R[1, 0] * x[i] + R[1, 1] * y[i] + R[1, 2] * z[i]
        r = np.sqrt(u * u + v * v)
        if r < FAR_M:
            cell[i] = sector_of(u, v) * BINS + bin_of(r)
            forward[i], left[i] = u, v
            up[i] = R[2, 0] * x[i] + R[2, 1] * y[i] + R[2, 2] * z[i]
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
