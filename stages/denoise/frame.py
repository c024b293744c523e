"""A range image that neighbours of a point are quickly looked up in: with a frame around it, as one row of numbers.

Columns go round, so the first are repeated after the last and the last before the first; above and below lies a row of
what is neither near nor far. The neighbour `i` rows up and `j` columns on of the cell at `k` is at `k + i * stride + j`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import RangeImage, elevation_bin, turn_of

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

BESIDE = 4
"""Columns that are repeated at either end."""
FIRST = np.int32(0)
ZERO, ENDLESS, NO_RANGE = np.float32(0.0), np.float32(np.inf), np.float32(np.nan)
"""Of the rows above and below: any comparison with it fails."""


@dataclass(frozen=True)
class Frame:
    """Cells of a range image in a row; `stride` of them to the next row."""

    range_m: F4
    """Of each cell; inf where there is nothing, NaN above and below the image."""
    point: I4
    """Number of each cell's point; -1 where there is none."""
    row_start: I4
    """(BINS,) cell of the first column, by bin of elevation."""
    columns: int
    place: I4
    """(n,) cell of each point; -1 for those that are not drawn."""
    away_m: F4
    """(n,) range of each point; not told of those that are not drawn."""

    @property
    def stride(self) -> int:
        return self.columns + 2 * BESIDE

    @classmethod
    def of(cls, image: RangeImage, x_m: F4, y_m: F4, z_m: F4) -> Frame:
        """Around the image of these points (n,), m."""
        columns = image.point.shape[1]
        range_m, point = _framed(image.range_m, image.point)
        row_start = (image.row_of_bin + 1) * np.int32(columns + 2 * BESIDE) + np.int32(BESIDE)
        place, away_m = _places(image.cell, x_m, y_m, z_m, columns)
        return cls(range_m, point, row_start, columns, place, away_m)


@kernel
def _framed(range_m: F4, point: I4) -> tuple[F4, I4]:
    rows, columns = range_m.shape
    ranges = np.full((rows + 2, columns + 2 * BESIDE), NO_RANGE, np.float32)
    points = np.full(ranges.shape, -1, np.int32)
    for v in range(rows):
        row = ranges[v + 1, BESIDE : BESIDE + columns]
        for u in range(columns):
            row[u] = range_m[v, u] if range_m[v, u] > ZERO else ENDLESS
        points[v + 1, BESIDE : BESIDE + columns] = point[v]
        for k in range(BESIDE):
            before, after = columns - BESIDE + k, BESIDE + columns + k
            ranges[v + 1, k], ranges[v + 1, after] = row[before], row[k]
            points[v + 1, k], points[v + 1, after] = point[v, before], point[v, k]
    return ranges.ravel(), points.ravel()


@kernel
def _places(cell: I4, x: F4, y: F4, z: F4, columns: int) -> tuple[I4, F4]:
    place, away = np.empty(len(cell), np.int32), np.empty(len(cell), np.float32)
    per_column, beside, first = 1.0 / columns, np.int32(2 * BESIDE), np.int32(columns + 3 * BESIDE)
    for n in range(len(cell)):
        k = cell[n]
        row = np.int32(
            (k + 0.5) * per_column
        )  # quicker than to divide whole numbers, and exact for fewer than 2^31
        place[n] = k + row * beside + first if k >= 0 else np.int32(-1)
        away[n] = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
    return place, away


@kernel
def places_from(x: F4, y: F4, z: F4, T: F4, row_start: I4, columns: int) -> tuple[I4, F4]:
    """Cell (n,) of another image that points (n,) lie in, and their ranges (n,) in it, m; T (4, 4) leads there."""
    row, column, away = np.empty(len(x), np.int32), np.empty(len(x), np.int32), np.empty(len(x), np.float32)
    width, last = np.float32(columns), np.int32(columns - 1)
    a, b, c, d = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    e, f, g, h = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    i, j, k, m = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for n in range(len(x)):  # nothing is looked up here, so that the compiler takes several points at once
        px, py, pz = (
            a * x[n] + b * y[n] + c * z[n] + d,
            e * x[n] + f * y[n] + g * z[n] + h,
            i * x[n] + j * y[n] + k * z[n] + m,
        )
        level = np.sqrt(px * px + py * py)
        away[n] = np.sqrt(level * level + pz * pz)
        row[n] = max(np.int32(elevation_bin(level, pz)), FIRST)  # also of what is not finite
        column[n] = max(min(np.int32(turn_of(px, py) * width), last), FIRST)
    for n in range(len(x)):
        column[n] += row_start[row[n]]
    return column, away
