"""Mean map entropy: how crisp a cloud is, without any truth.

h(q) = 1/2 ln det(2 pi e Sigma(q)), Sigma(q) the sample covariance of the neighbours of q within radius r (q among
them). A plane with Gaussian noise s << r has h = 1/2 ln((2 pi e)^3 r^4 s^2 / 16): ln 2 more when s doubles.
Droeschel and Behnke 2018 use the same figure. Values of tools that define the constant differently do not compare.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.halves import in_halves
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

REACH = 2
"""Columns to look at on each side: they are half as wide as the largest radius."""
_CONSTANT = 0.5 * 3.0 * np.log(2.0 * np.pi * np.e)


def point_entropies(
    points: NDArray[np.float32], queries: NDArray[np.int64], radii_m: tuple[float, ...], min_neighbours: int
) -> F8:
    """Entropy (m, k), nat, at the points with indices `queries` (m,) of `points` (n, 3), m, for k radii.

    Radii increase. NaN where fewer than `min_neighbours` points lie within the radius, or where they lie on a plane exactly.
    """
    if len(queries) == 0:
        return np.empty((0, len(radii_m)))
    if list(radii_m) != sorted(radii_m):
        raise ValueError(f"radii must increase: {radii_m}")
    radii = np.array(radii_m, float)
    columns = _Columns(points, float(radii.max()) / REACH)
    wanted = points[queries].astype(np.float32)
    out = np.full((len(queries), len(radii)), np.nan)

    def work(rows: slice) -> None:
        _entropies(
            columns.points, columns.starts, columns.shape, columns.low, columns.size_m, wanted[rows], radii,
            min_neighbours, out[rows],
        )  # fmt: skip

    in_halves(work, len(wanted))
    return out


def mean_entropy(entropies: F8) -> tuple[F8, F8]:
    """Mean map entropy (k,), nat, and the share (k,) of points with enough neighbours, from `point_entropies`."""
    valid = np.isfinite(entropies)
    count = valid.sum(axis=0)
    total = np.where(valid, entropies, 0.0).sum(axis=0)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean, count / max(len(entropies), 1)


class _Columns:
    """Points sorted into upright columns with a square base of edge `size_m`, by counting."""

    def __init__(self, points: NDArray[np.float32], size_m: float) -> None:
        x, y = points[:, 0], points[:, 1]
        self.low = np.array([x.min(), y.min()], float)
        span = np.array([x.max(), y.max()], float) - self.low
        self.size_m = max(size_m, float(span.max()) / 4096)
        self.shape = np.floor(span / self.size_m).astype(np.int64) + 1
        flat = _cells(points, self.low, self.size_m, int(self.shape[1]))
        self.starts, order = _counting_sort(flat, int(self.shape.prod()))
        self.points = points[order]


@kernel
def _cells(points: NDArray[np.float32], low: F8, size_m: float, across: int) -> NDArray[np.int64]:
    """Number of the column each point (n, 3) lies in, `across` columns to a row."""
    out = np.empty(len(points), np.int64)
    for n in range(len(points)):
        row: Any = np.int64(np.floor((points[n, 0] - low[0]) / size_m))
        out[n] = row * across + np.int64(np.floor((points[n, 1] - low[1]) / size_m))
    return out


@kernel
def _counting_sort(cell: NDArray[np.int64], cells: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
def _entropies(
    points: NDArray[np.float32], starts: NDArray[np.int64], shape: NDArray[np.int64], low: F8, size_m: float,
    queries: NDArray[np.float32], radii: F8, min_neighbours: int, out: F8,
) -> None:  # fmt: skip
    """Fill `out` (m, k), which is NaN, for the queries (m, 3)."""
    squared_radii = radii * radii
    for i in range(len(queries)):
        sums = np.zeros((len(radii), 10))  # count, x y z, xx xy xz yy yz zz about the query
        cx: Any = np.int64(np.floor((queries[i, 0] - low[0]) / size_m))
        cy: Any = np.int64(np.floor((queries[i, 1] - low[1]) / size_m))
        for gx in range(max(cx - REACH, 0), min(cx + REACH + 1, shape[0])):
            first = gx * shape[1]
            begin = starts[first + max(cy - REACH, 0)]
            end = starts[first + min(cy + REACH + 1, shape[1])]
            _gather(points, begin, end, queries[i], squared_radii, sums)
        for k in range(len(radii)):
            if k > 0:
                sums[k] += sums[k - 1]
            if sums[k, 0] >= min_neighbours:
                out[i, k] = _entropy(sums[k])


@kernel
def _gather(
    points: NDArray[np.float32], begin: Any, end: Any, query: NDArray[np.float32], squared_radii: F8, sums: F8
) -> None:
    """Add each point to the moments of the smallest radius that holds it; radii increase."""
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


@kernel
def _entropy(m: F8) -> Any:
    """1/2 ln det(2 pi e Sigma) from moments; NaN when Sigma is singular to rounding."""
    n = m[0]
    x, y, z = m[1] / n, m[2] / n, m[3] / n
    share = 1.0 / (n - 1.0)
    xx, xy, xz = (m[4] - n * x * x) * share, (m[5] - n * x * y) * share, (m[6] - n * x * z) * share
    yy, yz, zz = (m[7] - n * y * y) * share, (m[8] - n * y * z) * share, (m[9] - n * z * z) * share
    det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    scale = (xx + yy + zz) / 3.0
    if det <= 1e-12 * scale * scale * scale:
        return np.nan
    return _CONSTANT + 0.5 * np.log(det)
