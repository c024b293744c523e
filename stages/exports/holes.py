"""Small holes of a raster, filled from what lies around them; nothing is ever extended beyond its edge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel

F4 = NDArray[np.float32]
Known = NDArray[np.bool_]
ALL_SIDES = 0b1111


def fill_holes(layers: F4, known: Known, reach: int) -> tuple[F4, Known]:
    """Values of the cells inside a margin of `reach` cells, and which of them have one now.

    An empty cell gets the mean of the known cells within `reach`, weighted by the inverse square of their distance
    (Shepard 1968), if there is one in each of its four quadrants: no half-plane of known cells touches all four, so that
    a straight edge of the raster never grows. Only known cells count, in any order of filling the result is the same.

    layers : (k, rows + 2 reach, columns + 2 reach), filled each by itself.
    known : (rows + 2 reach, columns + 2 reach).
    """
    rows, columns = known.shape[0] - 2 * reach, known.shape[1] - 2 * reach
    filled = np.zeros((len(layers), rows, columns), np.float32)
    has = np.zeros((rows, columns), np.bool_)
    steps = np.array(_disc(reach), np.int64).reshape(-1, 4)
    _fill(np.ascontiguousarray(layers, np.float32), np.ascontiguousarray(known), steps, filled, has)
    return filled, has


@kernel
def _fill(layers: F4, known: Known, steps: NDArray[np.int64], filled: F4, has: Known) -> None:
    """steps (m, 4): up, right, bit of the quadrant, square of the distance."""
    reach = (known.shape[0] - has.shape[0]) // 2
    for i in range(has.shape[0]):
        for j in range(has.shape[1]):
            if known[i + reach, j + reach]:
                has[i, j] = True
                for k in range(layers.shape[0]):
                    filled[k, i, j] = layers[k, i + reach, j + reach]
                continue
            sides = 0
            for m in range(steps.shape[0]):
                if known[i + reach + steps[m, 0], j + reach + steps[m, 1]]:
                    sides |= steps[m, 2]
            if sides != ALL_SIDES:
                continue
            has[i, j] = True
            for k in range(layers.shape[0]):
                total, weights = 0.0, 0.0
                for m in range(steps.shape[0]):
                    row, column = i + reach + steps[m, 0], j + reach + steps[m, 1]
                    if known[row, column]:
                        weight = 1.0 / steps[m, 3]
                        total += weight * layers[k, row, column]
                        weights += weight
                filled[k, i, j] = total / weights


def _disc(reach: int) -> list[tuple[int, int, int, int]]:
    """The steps to every other cell within a distance."""
    return [
        (up, right, 1 << _quadrant(up, right), up * up + right * right)
        for up in range(-reach, reach + 1)
        for right in range(-reach, reach + 1)
        if 0 < up * up + right * right <= reach * reach
    ]


def _quadrant(up: int, right: int) -> int:
    """0 to 3 counter-clockwise; each half-axis belongs to the quadrant that follows it."""
    if right > 0 and up >= 0:
        return 0
    if right <= 0 and up > 0:
        return 1
    if right < 0:
        return 2
    return 3
