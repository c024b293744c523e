"""Scans as screens: what may move in the present one, and what the neighbours show behind it.

A neighbour's screen is the nearest thing around each of its directions that is no ground, since attitudes are not known any
better; the present scan is thinned to the nearest static point of a few columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.stages.denoise.window import View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import RangeImage

F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]

STATIC, GROUND = int(PointClass.STATIC), int(PointClass.GROUND)
NOTHING, NOBODY, ZERO, ENDLESS = np.int32(0), np.int32(-1), np.float32(0.0), np.float32(np.inf)
WHOLE = np.uint64
"""Of cells that are looked up: a signed number is asked each time whether it counts from the end."""
WINDOW_RAD = np.radians(0.45)
"""Azimuth around a direction in which nothing may be near: attitude is known that well over a second."""
MOST_CELLS = 45_000
"""A finer image is thinned to this, along its rows."""


@dataclass(frozen=True)
class Screen:
    """A neighbour as a screen behind the points of a scan."""

    image: RangeImage
    nearest_m: F4
    """(rows, columns) range of the nearest point around each cell that is not ground; inf where there is none."""

    @classmethod
    def of(cls, view: View) -> Screen:
        half = int(np.clip(np.ceil(WINDOW_RAD / view.image.column_rad), 1, 8))
        return cls(view.image, _nearest(view.image.point, view.image.range_m, view.classes, half))


@dataclass(frozen=True)
class Thin:
    """A range image of the points that may move."""

    point: I4
    """(rows, columns) -1 where there is none."""
    range_m: F4
    """(rows, columns) 0 where there is none."""
    stride: int
    """Columns of the image in one of these."""
    cell: I4
    """(m,) cells in which there is one."""
    x_m: F4
    """(m,) coordinates of these."""
    y_m: F4
    z_m: F4

    @classmethod
    def of(cls, scan: DeskewedScan, image: RangeImage, classes: U1) -> Thin:
        """The STATIC ones of a scan's `classes` (n,)."""
        stride = max(1, -(-image.point.size // MOST_CELLS))
        point, range_m = _thin(image.point, image.range_m, classes, stride)
        return cls(point, range_m, stride, *_listed(scan.x_m, scan.y_m, scan.z_m, point))


@kernel
def _nearest(point: I4, range_m: F4, classes: U1, half: int) -> F4:
    """Within `half` columns and one row of each cell."""
    rows, columns = point.shape
    along = np.empty((rows, columns), np.float32)
    wide = np.empty(columns + 2 * half, np.float32)  # the row, continued round the seam
    for v in range(rows):
        for u in range(columns):
            p = point[v, u]
            stands = (p >= 0) & (classes[WHOLE(max(p, NOTHING))] != GROUND)
            wide[WHOLE(half + u)] = range_m[v, u] if stands else ENDLESS
        for k in range(half):
            wide[k], wide[half + columns + k] = wide[columns + k], wide[half + k]
        row = along[v]
        row[:] = wide[:columns]
        for d in range(1, 2 * half + 1):
            _lower(row, wide[d : d + columns])
    out = along.copy()
    for v in range(rows):
        if v > 0:
            _lower(out[v], along[v - 1])
        if v + 1 < rows:
            _lower(out[v], along[v + 1])
    return out


@kernel
def _lower(one: F4, other: F4) -> None:
    """The lesser of both into the first."""
    for u in range(len(one)):
        one[u] = other[u] if other[u] < one[u] else one[u]


@kernel
def _thin(point: I4, range_m: F4, classes: U1, stride: int) -> tuple[I4, F4]:
    """The nearest STATIC point of every `stride` columns."""
    rows, columns = point.shape
    fewer = (columns + stride - 1) // stride
    out, ranges = np.empty((rows, fewer), np.int32), np.empty((rows, fewer), np.float32)
    row = np.full(fewer * stride, np.inf, np.float32)
    for v in range(rows):
        for u in range(columns):
            p = point[v, u]
            stands = (p >= 0) & (classes[WHOLE(max(p, NOTHING))] == STATIC)
            row[WHOLE(u)] = range_m[v, u] if stands else ENDLESS
        for w in range(fewer):
            best, which = ENDLESS, NOTHING
            for u in range(w * stride, w * stride + stride):
                if row[WHOLE(u)] < best:
                    best, which = row[WHOLE(u)], np.int32(u)
            found = best < ENDLESS
            out[v, w], ranges[v, w] = (point[v, which], best) if found else (NOBODY, ZERO)
    return out, ranges


@kernel
def _listed(x: F4, y: F4, z: F4, point: I4) -> tuple[I4, F4, F4, F4]:
    """Cells (m,) in which there is a point, and their coordinates."""
    cell, points = np.empty(point.size + 1, np.int32), point.ravel()
    found = 0
    for k in range(len(points)):
        cell[found] = k
        found += int(points[k] >= 0)
    a, b, c = np.empty(found, np.float32), np.empty(found, np.float32), np.empty(found, np.float32)
    for m in range(found):
        i = points[cell[m]]
        a[m], b[m], c[m] = x[i], y[i], z[i]
    return cell[:found].copy(), a, b, c
