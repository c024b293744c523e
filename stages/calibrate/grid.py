"""A grid of corners and the pattern in it: a detector may take the ends of the outer squares for one row more."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8

U1 = NDArray[np.uint8]
_MOST_ROWS = 2
"""Rows or columns too many that can be the ends of squares."""
_LIKE_OTHERS = 0.4
"""Contrast between the squares of an outer row, of the usual one, from which it is a row of squares."""


def pattern_in(image: U1, grid: F8, rows: int, columns: int) -> F8 | None:
    """The part (rows, columns, 2) of a grid (r, c, 2) of corners in a grey image around which all squares are dark and
    bright in turn, and beyond which they are not; turned if need be.

    None where there is none, or more than one: then the pattern is larger than that.
    """
    for turned in (grid, grid.transpose(1, 0, 2)[:, ::-1]):
        if turned.shape[:2] == (rows, columns):
            return turned
    found = [
        part
        for turned in (grid, grid.transpose(1, 0, 2)[:, ::-1])
        for part in _parts(image, turned, rows, columns)
    ]
    return found[0] if len(found) == 1 else None


def _parts(image: U1, grid: F8, rows: int, columns: int) -> list[F8]:
    spare = grid.shape[0] - rows, grid.shape[1] - columns
    if not all(0 <= s <= _MOST_ROWS for s in spare):
        return []
    contrast = _contrast(image, grid)
    usual = np.median(np.abs(contrast[1:-1, 1:-1]))
    found = []
    for i in range(spare[0] + 1):
        for j in range(spare[1] + 1):
            squares = contrast[i : i + rows + 1, j : j + columns + 1]
            outer = (squares[0], squares[-1], squares[:, 0], squares[:, -1])
            phase = np.sign(squares[1:-1, 1:-1].mean())
            if min(float(phase * line.mean()) for line in outer) > _LIKE_OTHERS * usual:
                found.append(grid[i : i + rows, j : j + columns])
    return found


def _contrast(image: U1, grid: F8) -> F8:
    """Grey of every square about the corners (r + 1, c + 1), less the mean of the squares beside it in its row and
    column, the sign changed from square to square: alike within a pattern, near zero beside it."""
    import cv2

    wide = _widened(_widened(grid).transpose(1, 0, 2)).transpose(1, 0, 2)
    centres = (wide[:-1, :-1] + wide[1:, :-1] + wide[:-1, 1:] + wide[1:, 1:]) / 4
    x, y = (np.ascontiguousarray(centres[..., k], np.float32) for k in range(2))
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    light = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    sign = np.where(np.add.outer(np.arange(len(light)), np.arange(light.shape[1])) % 2, -1.0, 1.0)
    along = np.stack([_beside(light, axis) for axis in (0, 1)])
    # an outer row is judged along itself: what is beyond it is no square
    both = along.mean(axis=0)
    both[[0, -1]], both[:, [0, -1]] = along[1][[0, -1]], along[0][:, [0, -1]]
    return np.asarray(sign * (light - both))


def _beside(light: F8, axis: int) -> F8:
    """Mean of the two neighbours along an axis; of the one at an end."""
    padded = np.concatenate((light.take([1], axis), light, light.take([-2], axis)), axis)
    n = light.shape[axis]
    return np.asarray((padded.take(range(n), axis) + padded.take(range(2, n + 2), axis)) / 2)


def _widened(grid: F8) -> F8:
    """With a row more at both ends, as far as the last two are apart."""
    return np.concatenate((2 * grid[:1] - grid[1:2], grid, 2 * grid[-1:] - grid[-2:-1]))
