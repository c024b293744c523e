"""Which points of a cloud have a point of another within a few centimetres; memory grows with the points asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import EMPTY, Float, find_slot, key_of, pack, table_length

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]
Mask = NDArray[np.bool_]

COARSE_CELLS = 2.5
"""Edge of the cells that sort out points far from every query, in reaches."""
TOUCHED = 27
"""Cells that the reaches of all points of one cell touch."""


def near(queries: F4, points: F4, reach_m: float) -> Mask:
    """Which queries (m, 3) have one of the points (n, 3) within `reach_m`, the reach included; all float32, m.

    The reach is that of float32, in which the coordinates are: what lies at 0.05 m exactly is near for 0.05 m.
    """
    if len(queries) == 0 or len(points) == 0:
        return np.zeros(len(queries), np.bool_)
    queries = np.ascontiguousarray(queries, np.float32)
    reach = float(np.float32(reach_m))
    close = points[_close(queries, points, reach)]
    cells = np.full(table_length(max(len(close), 1)), EMPTY, np.int64)
    first = np.full(len(cells), -1, np.int32)
    following = np.full(len(close), -1, np.int32)
    _chain(close, 1.0 / reach, cells, first, following)
    return np.asarray(_near(queries, close, reach, cells, first, following))


def _close(queries: F4, points: F4, reach: float) -> Mask:
    """Points in the coarse cells that the reach of a query touches."""
    per_m = 1.0 / (COARSE_CELLS * reach)
    distinct = _distinct_cells(queries, per_m, np.full(table_length(len(queries)), EMPTY, np.int64))
    marked = np.full(table_length(TOUCHED * int(distinct)), EMPTY, np.int64)
    _mark(queries, 1.001 * reach, per_m, marked)
    return np.asarray(_in_marked(np.ascontiguousarray(points, np.float32), per_m, marked))


@kernel
def _distinct_cells(points: F4, per_m: Float, cells: I8) -> int:
    """Number of cells that hold a point; `cells` is filled."""
    found = 0
    for p in points:
        key = key_of(np.float64(p[0]), np.float64(p[1]), np.float64(p[2]), per_m)
        slot = find_slot(cells, key)
        if cells[slot] == EMPTY:
            cells[slot] = key
            found += 1
    return found


@kernel
def _mark(points: F4, reach: Float, per_m: Float, marked: I8) -> None:
    """Fill `marked` with the cells of the corners of the cube around each point: it is smaller than a cell."""
    for p in points:
        for corner in range(8):
            x = np.float64(p[0]) + (reach if corner & 1 else -reach)
            y = np.float64(p[1]) + (reach if corner & 2 else -reach)
            z = np.float64(p[2]) + (reach if corner & 4 else -reach)
            key = key_of(x, y, z, per_m)
            marked[find_slot(marked, key)] = key


@kernel
def _in_marked(points: F4, per_m: Float, marked: I8) -> Mask:
    out = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        key = key_of(np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2]), per_m)
        out[i] = marked[find_slot(marked, key)] != EMPTY
    return out


@kernel
def _chain(points: F4, per_m: Float, cells: I8, first: I4, following: I4) -> None:
    """Points of each cell one after the other: the `first` of the cell's slot, then the `following` of each."""
    for i in range(len(points)):
        key = key_of(np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2]), per_m)
        slot = find_slot(cells, key)
        cells[slot] = key
        following[i] = first[slot]
        first[slot] = i


@kernel
def _near(queries: F4, points: F4, reach: Float, cells: I8, first: I4, following: I4) -> Mask:
    out = np.zeros(len(queries), np.bool_)
    for i in range(len(queries)):
        out[i] = _has_neighbour(queries[i], points, reach, cells, first, following)
    return out


@kernel
def _has_neighbour(query: F4, points: F4, reach: Float, cells: I8, first: I4, following: I4) -> Any:
    x, y, z = np.float64(query[0]), np.float64(query[1]), np.float64(query[2])
    ci, cj, ck = (
        np.int64(np.floor(x / reach)), np.int64(np.floor(y / reach)), np.int64(np.floor(z / reach)),
    )  # fmt: skip
    # One cell more on each side: rounding may put a point at the reach exactly into the next but one.
    for i in range(ci - 2, ci + 3):
        for j in range(cj - 2, cj + 3):
            for k in range(ck - 2, ck + 3):
                slot = find_slot(cells, pack(i, j, k))
                if cells[slot] == EMPTY:
                    continue
                at = first[slot]
                while at >= 0:
                    dx, dy = np.float64(points[at, 0]) - x, np.float64(points[at, 1]) - y
                    dz = np.float64(points[at, 2]) - z
                    if dx * dx + dy * dy + dz * dz <= reach * reach:
                        return True
                    at = following[at]
    return False
