"""What surrounds a return in the image of directions of its scan, by what the returns there are taken for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.clean.incidence import COLUMN_BITS, I4, LAST_COLUMN, ROWS
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I8 = NDArray[np.int64]
U1 = NDArray[np.uint8]

GROUND_CLASS, EGO, OUT_OF_RANGE = int(PointClass.GROUND), int(PointClass.EGO), int(PointClass.OUT_OF_RANGE)

OTHER, SOLID, GROUND, AIR, WENT, NOTHING = range(6)
"""What a return is taken for while others ask about it. NOTHING: the own vehicle, and what is out of range."""
BEYOND = NOTHING
"""In counts of what lies around: that which is farther off than near, and behind."""

BESIDE, ABOVE = 4, 3
"""Cells of the image to each side, and upwards and downwards, that lie around."""
NEAR_M, NEAR_PER_M = 0.6, 0.03
"""What is nearer than this, which grows with the range, lies around."""
ROUNDED, ZERO = 1.0001, np.float32(0.0)
"""Returns whose ranges differ by so many times the distance are farther apart than it."""
NEXT, OUT_M = 2, 0.3
"""What is nearer by so much than the next returns, in as many cells to the left and to the right, sticks out."""


@kernel
def seen_ranges(away: F4, taken: U1, image: I4) -> F4:
    """Range (ROWS, COLUMNS), m, of what lies in each direction; 0 where nothing does that is looked at."""
    out = np.zeros(image.shape, np.float32)
    seen, ranges = image.reshape(-1), out.reshape(-1)
    for k in range(len(seen)):
        if seen[k] >= 0 and taken[seen[k]] != NOTHING:
            ranges[k] = away[seen[k]]
    return out


@kernel
def look_around(
    x: F4, y: F4, z: F4, away: F4, n: int, cell: int, image: I4, ranges: F4, taken: U1, around: I8, ground_m: F8
) -> None:  # fmt: skip
    """Count what the returns near return n are taken for, and those beyond; sum of the heights of the ground, m."""
    around[:] = 0
    ground_m[0] = 0.0
    if cell < 0:
        return
    row, column = cell >> COLUMN_BITS, cell & LAST_COLUMN
    square = x[n] * x[n] + y[n] * y[n] + z[n] * z[n]
    near = NEAR_M + NEAR_PER_M * np.sqrt(square)
    surely, r, beyond = np.float32(ROUNDED * near), away[n], 0
    for v in range(max(row - ABOVE, 0), min(row + ABOVE + 1, ROWS)):
        for du in range(-BESIDE, BESIDE + 1):
            u = (column + du) & LAST_COLUMN
            behind = ranges[v, u] - r
            beyond += behind >= surely
            if not -surely < behind < surely:
                continue
            j = image[v, u]
            if j < 0 or j == n or ranges[v, u] == ZERO:
                continue
            dx, dy, dz = x[j] - x[n], y[j] - y[n], z[j] - z[n]
            if dx * dx + dy * dy + dz * dz < near * near:
                around[taken[j]] += 1
                if taken[j] == GROUND:
                    ground_m[0] += z[j]
            elif x[j] * x[j] + y[j] * y[j] + z[j] * z[j] > square:
                beyond += 1
    around[BEYOND] += beyond


@kernel
def over_ground(x: F4, y: F4, z: F4, away: F4, classes: U1, taken: U1, cell: I4, image: I4) -> B1:
    """Which ground returns (n,) have something around them that is taken to be in the air."""
    out = np.zeros(len(x), np.bool_)
    for n in range(len(x)):
        if taken[n] != AIR or cell[n] < 0:
            continue
        row, column = cell[n] >> COLUMN_BITS, cell[n] & LAST_COLUMN
        near = NEAR_M + NEAR_PER_M * np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        surely = np.float32(ROUNDED * near)
        for v in range(max(row - ABOVE, 0), min(row + ABOVE + 1, ROWS)):
            for du in range(-BESIDE, BESIDE + 1):
                j = image[v, (column + du) & LAST_COLUMN]
                if j >= 0 and abs(away[j] - away[n]) < surely and classes[j] == GROUND_CLASS and not out[j]:
                    dx, dy, dz = x[j] - x[n], y[j] - y[n], z[j] - z[n]
                    out[j] = dx * dx + dy * dy + dz * dz < near * near
    return out


@kernel
def sticks_out(away: F4, classes: U1, cell: I4, image: I4) -> B1:
    """Which returns (n,), `away` m from the sensor, stick out; the own vehicle and what is out of range never do."""
    out = np.zeros(len(away), np.bool_)
    for n in range(len(away)):
        if cell[n] < 0 or classes[n] == EGO or classes[n] == OUT_OF_RANGE:
            continue
        row, column = cell[n] >> COLUMN_BITS, cell[n] & LAST_COLUMN
        left = _is_beyond(away, image, row, column, -1, away[n] + OUT_M)
        out[n] = left and _is_beyond(away, image, row, column, 1, away[n] + OUT_M)
    return out


@kernel
def _is_beyond(away: F4, image: I4, row: int, column: int, side: int, beyond_m: float) -> bool:
    """Whether there is a return next to it on a side, farther off than that."""
    for step in range(1, NEXT + 1):
        j = image[row, (column + side * step) & LAST_COLUMN]
        if j >= 0:
            return bool(away[j] > beyond_m)
    return False
