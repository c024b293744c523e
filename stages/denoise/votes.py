"""Where the neighbours of a scan see through the places of what may move in it.

A place is free where a neighbour sees something well behind it and nothing near or before it in the directions around.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.denoise.frame import places_from
from scanloom.stages.denoise.screens import Screen, Thin
from scanloom.stages.denoise.window import Neighbour, View
from scanloom.stages.geometry.kernels import kernel

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I1 = NDArray[np.int8]
I4 = NDArray[np.int32]

FEWEST_SCANS, LOOKS = 3, 3
"""A neighbour is at least so many scans away; so many of each side are asked, the farthest first."""
MARGIN_M, MARGIN_PER_M, MARGIN_PER_TRAVEL = 0.3, 0.015, 0.015
"""What is seen behind a free place is farther by this, growing with range and with the way driven in between."""


class Votes(NamedTuple):
    """What the neighbours say of the place of each cell's point, all (rows, columns)."""

    free: B1
    """One side saw through."""
    denied: B1
    """One side saw through, but the farthest scan of the other saw something there."""
    told: B1
    """A neighbour can tell."""


def votes(neighbours: Sequence[Neighbour], thin: Thin, screen_of: Callable[[View], Screen]) -> Votes:
    """What the farther neighbours of either side say."""
    shape = thin.point.shape
    told, near = np.zeros(shape, np.bool_), np.zeros((2, *shape), np.bool_)
    count = np.zeros((2, *shape), np.int8)
    for k, side in enumerate((-1, 1)):
        for rank, each in enumerate(_asked(neighbours, side)):
            _ask(thin, each, screen_of(each.view), rank > 0, count[k], near[k], told)
    before, after = count > 1
    return Votes(before | after, (before & near[1]) | (after & near[0]), told)


def _ask(
    thin: Thin, neighbour: Neighbour, screen: Screen, again: bool, count: I1, near: B1, told: B1
) -> None:  # fmt: skip
    """A neighbour's answers, into (rows, columns); `again` only of what was free before."""
    T = neighbour.T_neighbour_scan
    if T is None:
        return
    margin_m = MARGIN_M + MARGIN_PER_TRAVEL * float(np.linalg.norm(T[:3, 3]))
    image, columns = screen.image, screen.image.point.shape[1]
    _look(
        thin.cell, thin.x_m, thin.y_m, thin.z_m, T.astype(np.float32), image.row_of_bin * np.int32(columns), columns,
        image.range_m, screen.nearest_m, margin_m, again, count, near, told,
    )  # fmt: skip


def _asked(neighbours: Sequence[Neighbour], side: int) -> list[Neighbour]:
    """Neighbours of one side that are asked, the farthest first."""
    known = [
        each
        for each in neighbours
        if each.T_scan_neighbour is not None and each.offset * side >= FEWEST_SCANS
    ]
    known.sort(key=lambda each: -abs(each.offset))
    step = max(1, (len(known) - 1) // (LOOKS - 1)) if known else 1
    return known[::step][:LOOKS]


@kernel
def _look(
    cell: I4, x: F4, y: F4, z: F4, T: F4, row_start: I4, columns: int, range_m: F4, nearest_m: F4, margin_m: float,
    again: bool, counts: I1, nears: B1, tolds: B1,
) -> None:  # fmt: skip
    """Notes, in place, where the neighbour sees through, sees something near, or either."""
    base, per_m = np.float32(margin_m), np.float32(MARGIN_PER_M)
    free, near, told = counts.ravel(), nears.ravel(), tolds.ravel()
    first, behind = nearest_m.ravel(), range_m.ravel()
    if again:
        cell, x, y, z = _free(cell, x, y, z, free)
    place, away = places_from(x, y, z, T, row_start, columns)
    for m in range(len(cell)):
        k, at, r = cell[m], place[m], away[m]
        margin = base + per_m * r
        if first[at] < r + margin:
            if first[at] > r - margin and not again:
                near[k] = told[k] = True
        elif behind[at] > r + margin:
            told[k] = True
            free[k] += 1


@kernel
def _free(cell: I4, x: F4, y: F4, z: F4, free: I1) -> tuple[I4, F4, F4, F4]:
    """Those of the cells (m,) that were free, with their coordinates."""
    rows, found = np.empty(len(cell) + 1, np.int32), 0
    for m in range(len(cell)):
        rows[found] = m
        found += int(free[cell[m]] > 0)
    out, a, b, c = (
        np.empty(found, np.int32),
        np.empty(found, np.float32),
        np.empty(found, np.float32),
        np.empty(found, np.float32),
    )
    for k in range(found):
        m = rows[k]
        out[k], a[k], b[k], c[k] = cell[m], x[m], y[m], z[m]
    return out, a, b, c
