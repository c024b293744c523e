"""What moves, told before odometry: things through whose place the scans shortly before or after see clearly.

A point is looked up in the range images of a few neighbouring scans. Its place is free where such a scan sees something
well behind it and nothing near or before it in the directions around. Two scans of one side must agree, since what
drives off is seen through only afterwards, and the other side must not deny it. Then the connected things of the scan are judged as a whole, so that single
mistakes vanish: most of what the neighbours can tell of must be free. Ground never moves, and where the motion of the
LiDAR is unknown nothing does. Source: methods 1.5.1, the model-free version.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.denoise.screens import Screen, Thin
from scanloom.stages.denoise.votes import Votes, votes
from scanloom.stages.denoise.window import Moment, View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.segments import alike, connected
from scanloom.stages.geometry.voxels import Int

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]

STATIC = int(PointClass.STATIC)
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
        self._screens: dict[int, Screen] = {}

    def moving(self, moment: Moment, classes: U1) -> B1:
        """Which points (n,) move, among those that are STATIC in `classes` (n,), values of PointClass."""
        self._forget(moment)
        view = moment.view
        out = np.zeros(len(view.scan), np.bool_)
        thin = Thin.of(view.scan, view.image, classes)
        said = votes(moment.neighbours, thin, self._screen)
        if np.count_nonzero(said.free) < LEAST_FREE:
            return out
        thing, count = connected(thin.range_m)
        moves = _judged(view, thin, thing, count, said)
        if not moves.any():
            return out
        gate_m = _gates(view.image.point.shape[1], thin.range_m, thin.stride, thing, moves)
        marked: B1 = _spread(view.image.cell, view.frame.away_m, classes, gate_m)
        return marked

    def _screen(self, view: View) -> Screen:
        index = view.scan.scan_index
        if index not in self._screens:
            self._screens[index] = Screen.of(view)
        return self._screens[index]

    def _forget(self, moment: Moment) -> None:
        around = {each.scan.scan_index for each in (moment.view, *(n.view for n in moment.neighbours))}
        self._screens = {k: screen for k, screen in self._screens.items() if k in around}


def _judged(view: View, thin: Thin, thing: I4, count: Int, said: Votes) -> B1:
    """Which of the `count` things move."""
    points, free, denied, told, length_m = _counted(
        view.scan.x_m, view.scan.y_m, thin.point, thing, count, *said
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
