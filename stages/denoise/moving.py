"""What moves, told before odometry: things through whose place the scans shortly before or after see clearly.

A point is looked up in the range images of a few neighbouring scans. Its place is free where such a scan sees something
well behind it and nothing near or before it in the directions around. Two scans of one side must agree, since what
drives off is seen through only afterwards, and the other side must not deny it. Then the connected things of the scan are judged as a whole, so that single
mistakes vanish: most of what the neighbours can tell of must be free. Ground never moves, and where the motion of the
LiDAR is unknown nothing does. Source: methods 1.5.1, the model-free version.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.stages.denoise.frame import places_from
from scanloom.stages.denoise.window import Moment, Neighbour, View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import RangeImage
from scanloom.stages.geometry.segments import alike, connected
from scanloom.stages.geometry.voxels import Int

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]

STATIC, GROUND = int(PointClass.STATIC), int(PointClass.GROUND)
NOTHING, NOBODY, ZERO, ENDLESS = np.int32(0), np.int32(-1), np.float32(0.0), np.float32(np.inf)
WHOLE = np.uint64
"""Of cells that are looked up: a signed number is asked each time whether it counts from the end."""

FEWEST_SCANS, LOOKS = 3, 3
"""A neighbour is at least so many scans away; so many of each side are asked, the farthest first."""
MARGIN_M, MARGIN_PER_M, MARGIN_PER_TRAVEL = 0.3, 0.015, 0.015
"""What is seen behind a free place is farther by this, growing with range and with the way driven in between."""
WINDOW_RAD = np.radians(0.45)
"""Azimuth around a direction in which nothing may be near: attitude is known that well over a second."""
MOST_CELLS = 45_000
"""A finer image is thinned to this, along its rows."""
LEAST_FREE = 5
"""Free points of a thing that moves."""
FREE_SHARE = 0.5
"""Of the points of a thing of which a neighbour can tell."""
DENIED_SHARE = 0.5
"""Of its free points those may be denied by the other side, which sees long vehicles, and ones that start, in the same place."""
TOLD_SHARE = 0.3
"""Of its points a neighbour can tell, at least."""
LARGEST_M = 25.0
"""Nothing longer drives on roads."""
MOST_MOVING, FEW = 0.2, 8
"""When a larger share of all things seems to move, and more than a few, the motion of the LiDAR must be wrong."""


class Movers:
    """Finds what moves, scan by scan; keeps what it made of the neighbours, which are seen again by the next scans."""

    def __init__(self) -> None:
        self._screens: dict[int, _Screen] = {}

    def moving(self, moment: Moment, classes: U1) -> B1:
        """Which points (n,) move, among those that are STATIC in `classes` (n,), values of PointClass."""
        self._forget(moment)
        view = moment.view
        out = np.zeros(len(view.scan), np.bool_)
        thin = _thinned(view.image, classes)
        votes = self._votes(moment, thin)
        if np.count_nonzero(votes.free) < LEAST_FREE:
            return out
        thing, count = connected(thin.range_m)
        moves = _judged(view, thin, thing, count, votes)
        if not moves.any():
            return out
        gate_m = _gates(view.image.point.shape[1], thin.range_m, thin.stride, thing, moves)
        marked: B1 = _spread(view.image.cell, view.frame.away_m, classes, gate_m)
        return marked

    def _votes(self, moment: Moment, thin: _Thin) -> _Votes:
        shape = thin.point.shape
        told, near = np.zeros(shape, np.bool_), np.zeros((2, *shape), np.bool_)
        count = np.zeros((2, *shape), np.int8)
        for k, side in enumerate((-1, 1)):
            for rank, each in enumerate(_asked(moment.neighbours, side)):
                self._ask(moment.view.scan, thin, each, rank > 0, count[k], near[k], told)
        before, after = count > 1
        return _Votes(before | after, (before & near[1]) | (after & near[0]), told)

    def _ask(
        self, scan: DeskewedScan, thin: _Thin, neighbour: Neighbour, again: bool, count: NDArray[np.int8], near: B1,
        told: B1,
    ) -> None:  # fmt: skip
        T, screen = neighbour.T_neighbour_scan, self._screen(neighbour.view)
        if T is None:
            return
        margin_m = MARGIN_M + MARGIN_PER_TRAVEL * float(np.linalg.norm(T[:3, 3]))
        cell, x, y, z = _listed(scan.x_m, scan.y_m, scan.z_m, thin.point, count, again)
        image, columns = screen.image, screen.image.point.shape[1]
        place, away_m = places_from(
            x, y, z, T.astype(np.float32), image.row_of_bin * np.int32(columns), columns
        )
        _look(cell, place, away_m, image.range_m, screen.nearest_m, margin_m, again, count, near, told)

    def _screen(self, view: View) -> _Screen:
        index = view.scan.scan_index
        if index not in self._screens:
            self._screens[index] = _Screen.of(view)
        return self._screens[index]

    def _forget(self, moment: Moment) -> None:
        around = {each.scan.scan_index for each in (moment.view, *(n.view for n in moment.neighbours))}
        self._screens = {k: screen for k, screen in self._screens.items() if k in around}


@dataclass(frozen=True)
class _Screen:
    """A neighbour as a screen behind the points of a scan."""

    image: RangeImage
    nearest_m: F4
    """(rows, columns) range of the nearest point around each cell that is not ground; inf where there is none."""

    @classmethod
    def of(cls, view: View) -> _Screen:
        half = int(np.clip(np.ceil(WINDOW_RAD / view.image.column_rad), 1, 8))
        return cls(view.image, _nearest(view.image.point, view.image.range_m, view.classes, half))


@dataclass(frozen=True)
class _Thin:
    """A range image of the points that may move."""

    point: I4
    """(rows, columns) -1 where there is none."""
    range_m: F4
    """(rows, columns) 0 where there is none."""
    stride: int
    """Columns of the image in one of these."""


class _Votes(NamedTuple):
    """What the neighbours say of the place of each cell's point, all (rows, columns)."""

    free: B1
    """One side saw through."""
    denied: B1
    """One side saw through, but the farthest scan of the other saw something there."""
    told: B1
    """A neighbour can tell."""


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


def _thinned(image: RangeImage, classes: U1) -> _Thin:
    stride = max(1, -(-image.point.size // MOST_CELLS))
    return _Thin(*_thin(image.point, image.range_m, classes, stride), stride)


def _judged(view: View, thin: _Thin, thing: I4, count: Int, votes: _Votes) -> B1:
    """Which of the `count` things move."""
    points, free, denied, told, length_m = _counted(
        view.scan.x_m, view.scan.y_m, thin.point, thing, count, *votes
    )
    moves: B1 = (
        (free >= LEAST_FREE)
        & (free >= FREE_SHARE * told)
        & (denied <= DENIED_SHARE * free)
        & (told >= TOLD_SHARE * points)
        & (length_m < LARGEST_M)
    )
    things = np.count_nonzero(told >= LEAST_FREE)
    if np.count_nonzero(moves) > max(FEW, MOST_MOVING * things):
        moves[:] = False
    return moves


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
def _listed(x: F4, y: F4, z: F4, point: I4, counts: NDArray[np.int8], again: bool) -> tuple[I4, F4, F4, F4]:
    """Cells (m,) that are looked at, those where it was free if `again`, and the coordinates of their points."""
    cell, points, free = np.empty(point.size + 1, np.int32), point.ravel(), counts.ravel()
    found = 0
    for k in range(len(points)):
        cell[found] = k
        found += int((points[k] >= 0) & ((not again) | (free[k] > 0)))
    a, b, c = np.empty(found, np.float32), np.empty(found, np.float32), np.empty(found, np.float32)
    for m in range(found):
        i = points[cell[m]]
        a[m], b[m], c[m] = x[i], y[i], z[i]
    return cell[:found].copy(), a, b, c


@kernel
def _look(
    cell: I4, place: I4, away: F4, range_m: F4, nearest_m: F4, margin_m: float, again: bool,
    counts: NDArray[np.int8], nears: B1, tolds: B1,
) -> None:  # fmt: skip
    """Notes, in place, where the neighbour sees through, sees something near, or either."""
    base, per_m = np.float32(margin_m), np.float32(MARGIN_PER_M)
    free, near, told = counts.ravel(), nears.ravel(), tolds.ravel()
    first, behind = nearest_m.ravel(), range_m.ravel()
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
def _counted(
    x: F4, y: F4, point: I4, thing: I4, count: Int, free: B1, denied: B1, told: B1
) -> tuple[I4, I4, I4, I4, F4]:
    """Of each thing (count,): points, how many of them are free, denied, told; and the diagonal of its outline, m."""
    sums = np.zeros((4, count), np.int32)
    low, high = np.full((2, count), np.inf, np.float32), np.full((2, count), -np.inf, np.float32)
    rows, columns = point.shape
    for v in range(rows):
        for u in range(columns):
            k, i = thing[v, u], point[v, u]
            if k < 0:
                continue
            sums[0, k] += 1
            sums[1, k] += free[v, u]
            sums[2, k] += denied[v, u]
            sums[3, k] += told[v, u]
            low[0, k], high[0, k] = min(low[0, k], x[i]), max(high[0, k], x[i])
            low[1, k], high[1, k] = min(low[1, k], y[i]), max(high[1, k], y[i])
    length_m = np.sqrt((high[0] - low[0]) ** 2 + (high[1] - low[1]) ** 2)
    return sums[0], sums[1], sums[2], sums[3], length_m


@kernel
def _gates(columns: int, thin_m: F4, stride: int, thing: I4, moves: B1) -> F4:
    """(rows, columns) range of the moving thing in each cell; -inf where there is none, which nothing is like."""
    rows, fewer = thin_m.shape
    out = np.full((rows, columns), -np.inf, np.float32)
    for v in range(rows):
        for w in range(fewer):
            if thing[v, w] >= 0 and moves[thing[v, w]]:
                out[v, w * stride : min(w * stride + stride, columns)] = thin_m[v, w]
    return out


@kernel
def _spread(cell: I4, away: F4, classes: U1, gate_m: F4) -> B1:
    """The STATIC points (n,) in whose cell lies a moving thing about as far away."""
    out, gates = np.zeros(len(cell), np.bool_), gate_m.ravel()
    for i in range(len(cell)):
        if cell[i] >= 0 and classes[i] == STATIC:
            out[i] = alike(away[i], gates[cell[i]])
    return out
