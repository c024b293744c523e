"""Small holes of a raster, filled from what lies around them; nothing is ever extended beyond its edge."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

F4 = NDArray[np.float32]


def fill_holes(values: F4, known: NDArray[np.bool_], reach: int) -> tuple[F4, NDArray[np.bool_]]:
    """Values of the cells inside a margin of `reach` cells, and which of them have one now.

    An empty cell gets the mean of the known cells within `reach`, weighted by the inverse square of their distance
    (Shepard 1968), if there is one in each of its four quadrants: no half-plane of known cells touches all four, so that
    a straight edge of the raster never grows. Only known cells count, in any order of filling the result is the same.

    values, known : (rows + 2 reach, columns + 2 reach).
    """
    rows, columns = known.shape[0] - 2 * reach, known.shape[1] - 2 * reach
    inner = (slice(reach, reach + rows), slice(reach, reach + columns))
    filled, has = values[inner].copy(), known[inner].copy()
    empty = np.argwhere(~has)
    if not reach or not len(empty) or not known.any():
        return filled, has
    base = np.where(known, values, np.float32(0.0)).astype(np.float64)
    weight, total = np.zeros(len(empty)), np.zeros(len(empty))
    sides = np.zeros((4, len(empty)), bool)
    for up, right in _disc(reach):
        at = (empty[:, 0] + reach + up, empty[:, 1] + reach + right)
        here = known[at]
        w = here / float(up * up + right * right)
        weight += w
        total += w * base[at]
        sides[_quadrant(up, right)] |= here
    good = sides.all(axis=0)
    filled[tuple(empty[good].T)] = (total[good] / weight[good]).astype(np.float32)
    has[tuple(empty[good].T)] = True
    return filled, has


def _disc(reach: int) -> Iterator[tuple[int, int]]:
    """Steps up and right to every other cell within a distance."""
    for up in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if 0 < up * up + right * right <= reach * reach:
                yield up, right


def _quadrant(up: int, right: int) -> int:
    """0 to 3 counter-clockwise; each half-axis belongs to the quadrant that follows it."""
    if right > 0 and up >= 0:
        return 0
    if right <= 0 and up > 0:
        return 1
    if right < 0:
        return 2
    return 3
