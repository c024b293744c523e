"""Correlative search: where two submaps fit together, over x, y, z and heading, without a start near the truth.

Submap i is a grid of columns whose bits are the height layers that hold something (methods 1.11); submap j is a set of
such columns that is turned, shifted, and raised. The score of a pose counts bits of j that meet bits of i, twice where
they meet exactly and once where they meet a neighbour. Branch and bound on grids in which a cell holds what any of the
2^k cells from it on hold, along all axes (the idea of Hess et al., ICRA 2016), bounds the scores of 8^k poses at once.
Boxes of poses leave a queue in the order of their bounds, so single poses leave it in the order in which an exhaustive
search would sort them, and what is found is exactly what that search finds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from scanloom.stages.geometry.voxels import Float, Int
from scanloom.stages.loops.columns import CELL_M, HALF_CELLS, TOP_LEVEL, U8, children, columns, score

I8 = NDArray[np.int64]
I4 = NDArray[np.int32]

YAW_STEP_RAD = np.radians(2.0)
APART_CELLS2, APART_STEPS = 4, 2
"""A peak beats all poses within 1 m (2 cells) and 5 degrees (2 steps) of it."""
MOST_COLUMNS = 384
BOUND_BIT, BOX_BIT, LEVEL_BIT, INDEX_MASK = 45, 44, 41, (1 << 41) - 1
"""A key of the queue: bound, 1 unless a single pose, level, complement of the index. The largest is first in it."""


@dataclass(frozen=True)
class Prior:
    """Where j is looked for in i: the middle of the window and half its widths; `reach_yaw_rad` of pi is all around."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    reach_m: float
    reach_z_m: float
    reach_yaw_rad: float

    @property
    def yaws_rad(self) -> F8:
        """Headings that are tried, rad."""
        if self.all_around:
            steps = np.arange(round(2 * np.pi / YAW_STEP_RAD))
        else:
            most = int(np.ceil(self.reach_yaw_rad / YAW_STEP_RAD - 1e-9))
            steps = np.arange(-most, most + 1)
        return np.asarray(self.yaw_rad + steps * YAW_STEP_RAD)

    @property
    def all_around(self) -> bool:
        return bool(self.reach_yaw_rad > np.pi - 0.5 * YAW_STEP_RAD)

    @property
    def reach(self) -> tuple[int, int]:
        """Cells to each side in x and y, and layers up and down."""
        return int(np.ceil(self.reach_m / CELL_M - 1e-9)), int(np.ceil(self.reach_z_m / CELL_M - 1e-9))


@dataclass(frozen=True)
class Peak:
    """A pose (4, 4) of j in i that fits better than all within 1 m and 5 degrees of it, and its share of the full score."""

    T_i_j: F8
    score: float


def peaks(
    grid: U8, low_m: float, points: F8, prior: Prior, most: int, least_share: float, least_score: float
) -> list[Peak]:
    """The best peaks, best first: at most `most`, none below `least_share` of the best, nor below `least_score`.

    `grid` is a `pyramid` of i over `low_m`; `points` (n, 3) are those of j that count, in its own level frame, m.
    """
    reach, reach_z = prior.reach
    xy, bits = columns(points, low_m - prior.z_m, reach_z)
    xy, bits = xy[:: len(xy) // MOST_COLUMNS + 1], bits[:: len(xy) // MOST_COLUMNS + 1]
    full = 2 * sum(int(b).bit_count() for b in bits)
    yaws = prior.yaws_rad
    cells = _turned(xy, yaws, prior)
    found, scores = _search(
        grid, cells, bits, reach, reach_z, prior.all_around, most, least_share, max(1, int(np.ceil(least_score * full)))
    )  # fmt: skip
    out = []
    for (a, x, y, z), value in zip(found, scores, strict=True):
        shift = np.array([x - reach, y - reach, z - reach_z]) * CELL_M
        T = pose(so3_exp([0.0, 0.0, yaws[a]]), shift + np.array([prior.x_m, prior.y_m, prior.z_m]))
        out.append(Peak(T, float(value) / full))
    return out


def _turned(xy: F8, yaws: F8, prior: Prior) -> I4:
    """Cells (a, n, 2) of columns at xy (n, 2) for each heading, at the middle of the window."""
    c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x, y = c * xy[:, 0] - s * xy[:, 1] + prior.x_m, s * xy[:, 0] + c * xy[:, 1] + prior.y_m
    cells = np.floor(np.stack((x, y), axis=2) / CELL_M) + HALF_CELLS
    return np.ascontiguousarray(np.clip(cells, -(10**6), 10**6), np.int32)


@kernel
def _search(
    grid: U8, cells: I4, bits: U8, reach: Int, reach_z: Int, around: bool, most: Int, least_share: Float, least: Int
) -> tuple[I8, I8]:  # fmt: skip
    """Places (k, 4) of the peaks in the window (heading, x, y, z) and their scores (k,), best first."""
    window = np.array([len(cells), 2 * reach + 1, 2 * reach + 1, 2 * reach_z + 1])
    gone = np.zeros((window[0], window[1], window[2], window[3]), np.bool_)
    found, scores = np.empty((most, 4), np.int64), np.empty(most, np.int64)
    peaks = 0
    queue, waiting = _roots(grid, cells, bits, reach, reach_z, window, least)
    while waiting > 0 and peaks < most:
        key = _first(queue, waiting)
        waiting -= 1
        bound = key >> BOUND_BIT
        if bound < least:
            break
        place = _place(INDEX_MASK - (key & INDEX_MASK), window)
        if (key >> BOX_BIT) & 1:
            level = (key >> LEVEL_BIT) & 7
            queue, waiting = _split(
                grid, cells, bits, reach, reach_z, window, place, level, least, queue, waiting
            )
            continue
        if peaks == 0:
            least = max(least, np.int64(np.ceil(least_share * bound)))
        if not _beaten(gone, window, place, around):
            found[peaks], scores[peaks] = place, bound
            peaks += 1
        gone[place[0], place[1], place[2], place[3]] = True
    return found[:peaks], scores[:peaks]


@kernel
def _roots(grid: U8, cells: I4, bits: U8, reach: Int, reach_z: Int, window: I8, least: Int) -> tuple[I8, Int]:
    """A queue of the largest boxes, which fill the window."""
    queue = np.empty(1 << 14, np.int64)
    waiting: Int = 0
    step = 1 << TOP_LEVEL
    for a in range(window[0]):
        for x in range(0, window[1], step):
            for y in range(0, window[2], step):
                for z in range(0, window[3], step):
                    bound = score(grid[TOP_LEVEL], cells[a], bits, x - reach, y - reach, z - reach_z)
                    if bound >= least:
                        queue, waiting = _wait(queue, waiting, _key(bound, TOP_LEVEL, a, x, y, z, window))
    return queue, waiting


@kernel
def _split(
    grid: U8, cells: I4, bits: U8, reach: Int, reach_z: Int, window: I8, place: I8, level: Int, least: Int, queue: I8,
    waiting: Int,
) -> tuple[I8, Int]:  # fmt: skip
    """Put the eight halves of a box into the queue, those that lie in the window and may hold something of use."""
    a, x, y, z = place[0], place[1], place[2], place[3]
    step = 1 << (level - 1)
    bound = children(grid[level - 1], cells[a], bits, x - reach, y - reach, z - reach_z, step)
    for k in range(8):
        u, v, w = x + (k >> 2) * step, y + ((k >> 1) & 1) * step, z + (k & 1) * step
        if bound[k] >= least and u < window[1] and v < window[2] and w < window[3]:
            queue, waiting = _wait(queue, waiting, _key(bound[k], level - 1, a, u, v, w, window))
    return queue, waiting


@kernel
def _beaten(gone: NDArray[np.bool_], window: I8, place: I8, around: bool) -> bool:
    """Whether a better pose lies near: it has gone before."""
    for turn in range(-APART_STEPS, APART_STEPS + 1):
        a = place[0] + turn
        if around:
            a %= window[0]
        elif a < 0 or a >= window[0]:
            continue
        for x in range(max(place[1] - 2, 0), min(place[1] + 3, window[1])):
            for y in range(max(place[2] - 2, 0), min(place[2] + 3, window[2])):
                for z in range(max(place[3] - 2, 0), min(place[3] + 3, window[3])):
                    apart2 = (x - place[1]) ** 2 + (y - place[2]) ** 2 + (z - place[3]) ** 2
                    if apart2 <= APART_CELLS2 and gone[a, x, y, z]:
                        return True
    return False


@kernel
def _key(bound: Int, level: Int, a: Int, x: Int, y: Int, z: Int, window: I8) -> Int:
    index = ((a * window[1] + x) * window[2] + y) * window[3] + z
    box = 1 if level > 0 else 0
    key: Int = (bound << BOUND_BIT) | (box << BOX_BIT) | (level << LEVEL_BIT) | (INDEX_MASK - index)
    return key


@kernel
def _place(index: Int, window: I8) -> I8:
    place = np.empty(4, np.int64)
    for k in range(3, 0, -1):
        place[k] = index % window[k]
        index //= window[k]
    place[0] = index
    return place


@kernel
def _wait(queue: I8, waiting: Int, key: Int) -> tuple[I8, Int]:
    """Put a key into the heap `queue`, which grows when it is full."""
    if waiting == len(queue):
        longer = np.empty(2 * len(queue), np.int64)
        longer[:waiting] = queue
        queue = longer
    at = waiting
    while at > 0 and queue[(at - 1) >> 1] < key:
        queue[at] = queue[(at - 1) >> 1]
        at = (at - 1) >> 1
    queue[at] = key
    return queue, waiting + 1


@kernel
def _first(queue: I8, waiting: Int) -> Int:
    """Take the largest key out of a heap of `waiting` keys."""
    first: Int = queue[0]
    last = queue[waiting - 1]
    at, below = 0, 1
    while below < waiting - 1:
        if below + 1 < waiting - 1 and queue[below + 1] > queue[below]:
            below += 1
        if queue[below] <= last:
            break
        queue[at] = queue[below]
        at, below = below, 2 * below + 1
    queue[at] = last
    return first
