"""Shapes around points: whether a point lies on lines between its neighbours in the image, and how many are near it.

Told of all cells at once, row by row, which takes less time than to look around every point that is asked about.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.denoise.frame import BESIDE, Frame
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import Float

F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

MOST_LINES, FAR_OFF = 4, np.float32(5.0)
COUNTS = 5
"""Near neighbours are told apart as none, one, up to three, up to seven, more."""
SURFACE = (MOST_LINES + 2) * COUNTS - 1
"""Shape of a point on a surface."""
FLAT = 128
"""Added to the shape of a cell that lies on the line between those beside it."""
NOISE_M, NOISE_PER_M, NEAR_M, NEAR_PER_M = (np.float32(c) for c in (0.05, 0.005, 0.3, 0.02))
"""A point lies on a line if it is off it by less than the noise; neighbours within the second pair are near."""
ASIDE = 2
"""Columns to each side that are looked at, of the row itself and of those above and below."""
ZERO, ONE, TWICE, FOUR, EIGHT, UNBENT, ENDLESS = (
    np.float32(c) for c in (0.0, 1.0, 2.0, 4.0, 8.0, 1e9, np.inf)
)
WHOLE = np.uint64


def cell_shapes(frame: Frame) -> U1:
    """Shape of each cell of a frame as a point in it has it that is as far away as the cell, and FLAT."""
    shapes: U1 = _cell_shapes(frame.range_m, frame.stride, frame.columns)
    return shapes


@kernel
def shapes_of(place: I4, away: F4, ranges: F4, stride: int, of_cell: U1, asked: I8) -> U1:
    """Shape (m,) of the points `asked`, and FLAT."""
    out = np.empty(len(asked), np.uint8)
    for m in range(len(asked)):
        k, r = WHOLE(place[asked[m]]), away[asked[m]]
        out[m] = of_cell[k] if ranges[k] == r else _shape_at(ranges, stride, k, r)  # type: ignore[arg-type]
    return out


@kernel
def _cell_shapes(ranges: F4, stride: int, columns: int) -> U1:
    out = np.zeros(len(ranges), np.uint8)
    wide = columns + 2 * ASIDE
    for first in range(stride + BESIDE, len(ranges) - stride, stride):
        low = ranges[first - stride - ASIDE : first - stride - ASIDE + wide]
        own = ranges[first - ASIDE : first - ASIDE + wide]
        high = ranges[first + stride - ASIDE : first + stride - ASIDE + wide]
        shape = out[first : first + columns]
        for u in range(columns):  # no branch, so that the compiler takes several cells at once
            r = own[u + 2]
            near = max(NEAR_M, NEAR_PER_M * r)
            count = (
                _near(low[u], r, near) + _near(low[u + 1], r, near) + _near(low[u + 2], r, near)
                + _near(low[u + 3], r, near) + _near(low[u + 4], r, near)
                + _near(own[u], r, near) + _near(own[u + 1], r, near)
                + _near(own[u + 3], r, near) + _near(own[u + 4], r, near)
                + _near(high[u], r, near) + _near(high[u + 1], r, near) + _near(high[u + 2], r, near)
                + _near(high[u + 3], r, near) + _near(high[u + 4], r, near)
            )  # fmt: skip
            beside, farther = bend(own[u + 3], own[u + 1], r), bend(own[u + 4], own[u], r)
            rising, upright = bend(high[u + 3], low[u + 1], r), bend(high[u + 2], low[u + 2], r)
            shape[u] = _shape(count, beside, farther, rising, upright, bend(high[u + 1], low[u + 3], r), r)
    return out


@kernel
def _shape_at(ranges: F4, stride: int, k: int, r: float) -> int:
    """The same of a point at range `r` in cell `k`."""
    step, near, count = WHOLE(stride), max(NEAR_M, NEAR_PER_M * r), -ONE
    first = k - step - WHOLE(ASIDE)
    for i in range(WHOLE(3)):
        for j in range(WHOLE(2 * ASIDE + 1)):
            count += _near(ranges[first + i * step + j], r, near)
    return _shape(
        count,
        bend(ranges[k + WHOLE(1)], ranges[k - WHOLE(1)], r),
        bend(ranges[k + WHOLE(2)], ranges[k - WHOLE(2)], r),
        bend(ranges[k + step + WHOLE(1)], ranges[k - step - WHOLE(1)], r),
        bend(ranges[k + step], ranges[k - step], r),
        bend(ranges[k + step - WHOLE(1)], ranges[k - step + WHOLE(1)], r),
        r,
    )


@kernel
def _shape(
    count: Float, beside: float, farther: float, rising: float, upright: float, falling: float, r: float
) -> int:
    """Shape of a point from the number of near neighbours and how far it is off each line, m."""
    noise = NOISE_M + NOISE_PER_M * r
    straight = (
        np.int32(beside < noise) + np.int32(farther < noise) + np.int32(rising < noise)
        + np.int32(upright < noise) + np.int32(falling < noise)
    )  # fmt: skip
    least = min(min(min(beside, farther), min(rising, upright)), falling)
    lines = np.int32(least < FAR_OFF * noise) * (np.int32(1) + min(straight, np.int32(MOST_LINES)))
    many = (
        np.int32(count >= ONE) + np.int32(count >= TWICE) + np.int32(count >= FOUR) + np.int32(count >= EIGHT)
    )
    return np.uint8(lines * np.int32(COUNTS) + many + np.int32(FLAT) * np.int32(beside < noise))  # type: ignore[return-value]


@kernel
def _near(a: float, r: float, near: Float) -> float:
    """One if there is something at about this range."""
    return ONE if abs(a - r) < near else ZERO  # type: ignore[return-value]


@kernel
def bend(a: float, b: float, r: float) -> float:
    """How far range `r` is off the line between its neighbours `a` and `b`: planes are straight in 1 / range."""
    both = a * b
    off = abs(TWICE * both / (a + b) - r)  # before it is asked whether there are two: so it is no branch
    return off if both < ENDLESS else UNBENT  # type: ignore[return-value]
