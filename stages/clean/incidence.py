"""How far along each ray space is certainly free: the return's range, less what the surface it met may hide.

A ray that grazes a surface runs close above it for long before it meets it: with a clearance c and an angle a between ray
and surface, the last c / sin(a). The angle comes from the neighbouring returns in an image of directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import turn_of

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

COLUMN_BITS = 10
ROWS, COLUMNS = 256, 1 << COLUMN_BITS
LOWEST_RAD, HIGHEST_RAD = np.radians(-56.0), np.radians(56.0)
ROW_RAD = (HIGHEST_RAD - LOWEST_RAD) / ROWS
BESIDE, ABOVE = 2, 5
"""Cells to each side, and upwards and downwards, in which the next return is looked for."""
LEAST_SINE, NONE = 0.02, 2.0
ZERO, HALF, WHOLE, ENDLESS = (np.float32(c) for c in (0.0, 0.5, 1.0, np.inf))
LOWEST_TURN, ROWS_PER_TURN = np.float32(LOWEST_RAD / (2.0 * np.pi)), np.float32(2.0 * np.pi / ROW_RAD)
COLUMNS_PER_TURN, LAST_COLUMN = np.float32(COLUMNS), np.int32(COLUMNS - 1)
ALL_ROWS, PER_ROW, NOWHERE = np.float32(ROWS), np.int32(COLUMNS), np.int32(-1)


def new_image() -> I4:
    """An image of directions to be filled with numbers of returns."""
    return np.empty((ROWS, COLUMNS), np.int32)


@kernel
def fill(x: F4, y: F4, z: F4, image: I4) -> tuple[I4, F4]:
    """Put the nearest return of every direction into the image; returns the cell (n,) of each, -1 outside, and its range."""
    cell, away = np.empty(len(x), np.int32), np.empty(len(x), np.float32)
    for n in range(len(x)):  # apart from the drawing, so that the compiler takes several points at once
        level = x[n] * x[n] + y[n] * y[n]
        r = np.sqrt(level + z[n] * z[n])
        up = turn_of(np.sqrt(level), z[n])
        row = ((up if up < HALF else up - WHOLE) - LOWEST_TURN) * ROWS_PER_TURN
        column = min(np.int32(turn_of(x[n], y[n]) * COLUMNS_PER_TURN), LAST_COLUMN)
        seen = (r > ZERO) & (r < ENDLESS) & (row >= ZERO) & (row < ALL_ROWS)
        cell[n], away[n] = np.int32(row) * PER_ROW + column if seen else NOWHERE, r
    image[:] = -1
    flat = image.reshape(-1)
    for n in range(len(x)):
        if cell[n] >= 0:
            before = flat[cell[n]]
            if before < 0 or away[n] < away[before]:
                flat[cell[n]] = n
    return cell, away


@kernel
def clear_ranges(x: F4, y: F4, z: F4, cell: I4, image: I4, clearance_m: float) -> F4:
    """Range (n,), m, up to which each ray passes freely; 0 for returns outside the image."""
    out = np.zeros(len(x), np.float32)
    for n in range(len(x)):
        if cell[n] < 0:
            continue
        row, column = cell[n] >> COLUMN_BITS, cell[n] & LAST_COLUMN
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        square = px * px + py * py + pz * pz
        beside = _beside(x, y, z, n, square, row, column, image)
        along = max(beside, _above(x, y, z, n, square, row, column, image))
        sine = np.sqrt(max(1.0 - along, 0.0))
        out[n] = np.sqrt(square) - clearance_m / max(sine, LEAST_SINE)
    return out


@kernel
def _beside(x: F4, y: F4, z: F4, n: int, square: float, row: int, column: int, image: I4) -> float:
    """Square of the cosine of the angle between ray and surface, by the returns left and right; of the steeper side at an
    edge."""
    best = NONE
    for side in (-1, 1):
        for step in range(1, BESIDE + 1):
            other = image[row, (column + side * step) & LAST_COLUMN]
            if other >= 0:
                best = min(best, _cosine2(x, y, z, n, square, other))
                break
    return best if best < NONE else 0.0


@kernel
def _above(x: F4, y: F4, z: F4, n: int, square: float, row: int, column: int, image: I4) -> float:
    """The same by the returns above and below."""
    best = NONE
    for side in (-1, 1):
        for step in range(1, ABOVE + 1):
            if not 0 <= row + side * step < ROWS:
                break
            other = image[row + side * step, column]
            if other >= 0:
                best = min(best, _cosine2(x, y, z, n, square, other))
                break
    return best if best < NONE else 0.0


@kernel
def _cosine2(x: F4, y: F4, z: F4, n: int, square: float, other: int) -> float:
    """Square of the cosine of the angle between the ray to a return, `square` m2 away, and the line to another return."""
    px, py, pz = float(x[n]), float(y[n]), float(z[n])
    dx, dy, dz = float(x[other]) - px, float(y[other]) - py, float(z[other]) - pz
    both = (dx * dx + dy * dy + dz * dz) * square
    along = dx * px + dy * py + dz * pz
    return along * along / both if both > 0.0 else 0.0
