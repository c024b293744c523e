"""What surrounds a return in the image of directions of its scan, by what the returns there are taken for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.clean.incidence import COLUMN_BITS, I4, LAST_COLUMN, ROWS
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int

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
CONTRAST_EDGES = np.array([0.08, 0.15, 0.25, 0.4, 0.6, 0.8])
"""Of intensities over those beside."""
ASIDE, UPWARDS = 2, 4
"""Cells to the left and to the right, and upwards and downwards, in which the next returns are looked for that a line is
drawn between."""
NOISE_M, NOISE_PER_M = 0.05, 0.005
"""A return is on a line if it is off it by less than this."""
BENT, BROKEN = 4.0, 20.0
"""So many times as much is a bend, and a break."""
OFF_LINE = 6
"""Bins of how a return lies to a line."""
DIM = 3
"""Bins of contrast from 1 to this one: much fainter than both returns beside it, which are about as far away."""


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
def stands_out(away: F4, intensity: F4, lost: float, classes: U1, cell: I4, image: I4) -> B1:
    """Which returns (n,), `away` m from the sensor, stick out, or are much fainter than both beside them.

    Intensities up to `lost` tell nothing. The own vehicle and what is out of range never stand out.
    """
    out = np.zeros(len(away), np.bool_)
    for n in range(len(away)):
        if cell[n] < 0 or classes[n] == EGO or classes[n] == OUT_OF_RANGE:
            continue
        row, column = cell[n] >> COLUMN_BITS, cell[n] & LAST_COLUMN
        left = _next(image, row, column, -1)
        if left < 0:
            continue
        beyond = away[n] + OUT_M
        faint = intensity[n] < CONTRAST_EDGES[DIM - 1] * float(intensity[left])
        if not (faint or away[left] > beyond):
            continue
        right = _next(image, row, column, 1)
        out[n] = right >= 0 and away[left] > beyond and away[right] > beyond
        if faint and not out[n]:
            out[n] = 0 < _contrast(away, intensity, lost, n, left, right) <= DIM
    return out


@kernel
def contrasts(away: F4, intensity: F4, lost: float, cell: I4, image: I4, asked: I8) -> U1:
    """Bins (n,) of the contrast of the returns `asked` (m,) to those beside them; 0 for the others."""
    out = np.zeros(len(away), np.uint8)
    for n in asked:
        if cell[n] >= 0:
            row, column = cell[n] >> COLUMN_BITS, cell[n] & LAST_COLUMN
            left, right = _next(image, row, column, -1), _next(image, row, column, 1)
            out[n] = _contrast(away, intensity, lost, n, left, right)
    return out


@kernel
def _next(image: I4, row: int, column: int, side: int) -> int:
    """The return next to a cell on a side, -1 when there is none."""
    for step in range(1, NEXT + 1):
        j = image[row, (column + side * step) & LAST_COLUMN]
        if j >= 0:
            return int(j)
    return -1


@kernel
def _contrast(away: F4, intensity: F4, lost: float, n: int, left: int, right: int) -> int:
    """Bin of the intensity of a return over that of the fainter of the near returns beside it; 0 when that tells nothing."""
    if not intensity[n] > lost:
        return 0
    count, fainter, near = 0, np.inf, NEAR_M + NEAR_PER_M * away[n]
    for j in (left, right):
        if j >= 0 and abs(away[j] - away[n]) < near and intensity[j] > lost:
            count += 1
            fainter = min(fainter, float(intensity[j]))
    if count == 0:
        return 0
    first = 1 if count == 2 else 1 + len(CONTRAST_EDGES) + 1
    k = 0
    while k < len(CONTRAST_EDGES) and intensity[n] >= CONTRAST_EDGES[k] * fainter:
        k += 1
    return first + k


@kernel
def off_line(ranges: F4, row: int, column: Int, r: float, upwards: int, aside: int, farthest: int) -> int:
    """Bin of how far a return at range `r` is off the line between the next ones on either side: no line, on it, about on it,
    before it, far before it, behind it. Lines are straight in 1 / range.
    """
    a, b, to_a, to_b = 0.0, 0.0, 0, 0
    for step in range(1, farthest + 1):
        if to_a == 0 and 0 <= row + step * upwards < ROWS:
            a = float(ranges[row + step * upwards, (column + step * aside) & LAST_COLUMN])
            to_a = step if a > 0.0 else 0
        if to_b == 0 and 0 <= row - step * upwards < ROWS:
            b = float(ranges[row - step * upwards, (column - step * aside) & LAST_COLUMN])
            to_b = step if b > 0.0 else 0
    if to_a == 0 or to_b == 0:
        return 0
    before = (to_a + to_b) * a * b / (to_a * a + to_b * b) - r
    noise = NOISE_M + NOISE_PER_M * r
    if abs(before) < BENT * noise:
        return 1 if abs(before) < noise else 2
    if before < 0.0:
        return 5
    return 3 if before < BROKEN * noise else 4
