"""What lies around a point: moments of its neighbours, found in upright columns.

Columns are half as wide as the largest radius. Moments are plain sums, so those of two clouds add up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.halves import in_halves
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
I8 = NDArray[np.int64]

REACH = 2
"""Columns to look at on each side."""
MOMENTS = 10
_MOST_COLUMNS = 4096
"""To each side of the grid: a cloud with a stray point far off must not fill the memory with empty columns."""


class Columns:
    """Points (n, 3) sorted into upright columns with a square base, by counting; `order` says where each came from."""

    def __init__(self, points: F4, radius_m: float) -> None:
        x, y = (points[:, 0], points[:, 1]) if len(points) else (np.zeros(1), np.zeros(1))
        self.low = np.array([x.min(), y.min()], float)
        span = np.array([x.max(), y.max()], float) - self.low
        self.size_m = max(radius_m / REACH, float(span.max()) / _MOST_COLUMNS)
        self.shape = np.floor(span / self.size_m).astype(np.int64) + 1
        flat = _cells(points, self.low, self.size_m, int(self.shape[1]))
        self.starts, self.order = _counting_sort(flat, int(self.shape.prod()))
        self.points = points[self.order]


def moments(columns: Columns, queries: F4, radii_m: F8) -> F8:
    """Sums (m, k, 10) over the neighbours of each query (m, 3) within each of k radii: 1, x, y, z, xx, xy, xz, yy, yz, zz.

    Coordinates are taken from the query, m. Radii increase; the largest is at most that of the columns.
    """
    sums = np.zeros((len(queries), len(radii_m), MOMENTS))

    def work(rows: slice) -> None:
        _moments(
            columns.points, columns.starts, columns.shape, columns.low, columns.size_m, queries[rows], radii_m, sums[rows]
        )  # fmt: skip

    in_halves(work, len(queries))
    return np.cumsum(sums, axis=1)


def covariances(moments: F8) -> F8:
    """Sample covariances (..., 3, 3), m2, from moments (..., 10); not finite with fewer than two points."""
    n = moments[..., :1]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, z = np.moveaxis(moments[..., 1:4] / n, -1, 0)
        means = np.stack((x * x, x * y, x * z, y * y, y * z, z * z), axis=-1)
        unique = (moments[..., 4:] - n * means) / (n - 1.0)
    rows = unique[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    return np.asarray(rows.reshape(*moments.shape[:-1], 3, 3))


@kernel
def _cells(points: F4, low: F8, size_m: float, across: int) -> I8:
    """Number of the column each point (n, 3) lies in, `across` columns to a row."""
    out = np.empty(len(points), np.int64)
    for n in range(len(points)):
        row: Any = np.int64(np.floor((points[n, 0] - low[0]) / size_m))
        out[n] = row * across + np.int64(np.floor((points[n, 1] - low[1]) / size_m))
    return out


@kernel
def _counting_sort(cell: I8, cells: int) -> tuple[I8, I8]:
    """Where each cell starts (cells + 1,), and the points ordered by cell (n,)."""
    starts = np.zeros(cells + 1, np.int64)
    for c in cell:
        starts[c + 1] += 1
    for i in range(cells):
        starts[i + 1] += starts[i]
    at = starts[:-1].copy()
    order = np.empty(len(cell), np.int64)
    for i in range(len(cell)):
        order[at[cell[i]]] = i
        at[cell[i]] += 1
    return starts, order


@kernel
def _moments(
    points: F4, starts: I8, shape: I8, low: F8, size_m: float, queries: F4, radii: F8, sums: F8
) -> None:
    """Fill `sums` (m, k, 10), each with the points between its radius and the one before."""
    squared_radii = radii * radii
    for i in range(len(queries)):
        cx: Any = np.int64(np.floor((queries[i, 0] - low[0]) / size_m))
        cy: Any = np.int64(np.floor((queries[i, 1] - low[1]) / size_m))
        first_y, last_y = max(cy - REACH, 0), min(cy + REACH + 1, shape[1])
        for gx in range(max(cx - REACH, 0), min(cx + REACH + 1, shape[0])):
            if first_y < last_y:
                begin, end = starts[gx * shape[1] + first_y], starts[gx * shape[1] + last_y]
                _gather(points, begin, end, queries[i], squared_radii, sums[i])


@kernel
def _gather(points: F4, begin: Any, end: Any, query: F4, squared_radii: F8, sums: F8) -> None:
    """Add each point to the moments of the smallest radius that holds it."""
    for j in range(begin, end):
        x = float(points[j, 0]) - float(query[0])
        y = float(points[j, 1]) - float(query[1])
        z = float(points[j, 2]) - float(query[2])
        squared = x * x + y * y + z * z
        if squared > squared_radii[-1]:
            continue
        for k in range(len(squared_radii)):
            if squared <= squared_radii[k]:
                sums[k, 0] += 1.0
                sums[k, 1] += x
                sums[k, 2] += y
                sums[k, 3] += z
                sums[k, 4] += x * x
                sums[k, 5] += x * y
                sums[k, 6] += x * z
                sums[k, 7] += y * y
                sums[k, 8] += y * z
                sums[k, 9] += z * z
                break
