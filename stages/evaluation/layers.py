"""Layers of upright surfaces: is a wall one sheet of points, or two with a gap?

A patch is what lies within a radius of a point on an upright surface. Its points are seen edge-on: distances along the
normal fall into a histogram, after the normal has been turned until the histogram is sharpest, which two parallel layers
do not hinder. A second layer is a second peak beyond a clear valley.

Not every second layer is an error. Both must cover the same part of the patch, so that windows set back in a wall, posts,
pipes and ledges before it do not count. And they must have been seen from the same side: a panel or a garden wall driven
past on both sides has two true faces.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.halves import in_halves
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.neighbourhoods import REACH, Columns
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int

F4 = NDArray[np.float32]
I1 = NDArray[np.int8]
I8 = NDArray[np.int64]

RADIUS_M = 1.0
"""Of a patch."""
DEPTH_M = 0.6
"""Points farther from the middle of the patch, along its normal, are something else."""
BIN_M = 0.02
_BINS = 60
STEP_RAD, STEPS = np.radians(0.5), 12
"""How far the normal is turned to each side to find the sharpest view."""
ENOUGH_POINTS = 150
"""Of a patch to turn its normal by."""
LEAST_POINTS = 40
_MOST_POINTS = 4096
LEAST_EXTENT_M = 1.0
"""A layer reaches so far along the wall and upwards, or it is a post or a ledge."""
STEP_M = 0.04
_STEPS = 50
"""In which extents are measured."""
LEAST_SHARE = 0.15
"""Of the points of a patch that a layer needs."""
HALF_LAYER = 4
"""Bins to each side of a peak that belong to it."""
DEEPEST_VALLEY = 0.5
"""A valley is at most this share of the lower peak."""
SIGMAS = 3.0
"""The lower peak stands so far above the valley, counted points being Poisson distributed."""
CELL_M = 0.25
"""Of the grid on the wall by which the layers are seen to lie behind each other."""
_CELLS = 8
LEAST_OVERLAP, LEAST_SPREAD = 0.6, 0.6
"""Of the points of the smaller layer so many have the other behind them, and of the cells of the patch so many have both, as
shares of what two layers strewn evenly would have."""
OUTWARDS = 0.5
"""Mean of the signs of the normals of a layer from which on it looks one way."""


class Patch(IntEnum):
    """What a patch of an upright surface is."""

    NONE = 0
    """Too few points, or too small."""
    SINGLE = 1
    DOUBLE = 2
    TWO_SIDED = 3


THICKNESS, GAP, APART = 0, 1, 2
"""Columns of what is measured of a patch: the thinnest slab that holds two thirds of its points, m (of a sheet with Gaussian
noise 1.94 standard deviations); between its layers, m, and between the middle times at which they were first met, s, both
NaN where there are no two."""
HELD = 2.0 / 3.0


def patches(
    columns: Columns, facing: I1, first_ns: I8, middles: F4, normals: F8, gap_m: tuple[float, float]
) -> tuple[NDArray[np.uint8], F8]:
    """Kind (m,) of each patch, a value of `Patch`, and what was measured of it (m, 3).

    columns : points of radius `RADIUS_M`.
    facing : (n, 3) normals of the points in the order of `columns.points`, any length, zeros where there is none.
    first_ns : (n,) when each was first met.
    middles, normals : (m, 3) of the patches; normals are unit vectors within some degrees.
    gap_m : least and largest distance of two layers.
    """
    kind, measured = np.zeros(len(middles), np.uint8), np.full((len(middles), 3), np.nan)
    gaps = np.array(gap_m)

    def work(rows: slice) -> None:
        _patches(
            columns.points, columns.starts, columns.shape, columns.low, columns.size_m, facing, first_ns, middles[rows],
            normals[rows], gaps, kind[rows], measured[rows],
        )  # fmt: skip

    in_halves(work, len(middles))
    return kind, measured


@kernel
def _patches(
    points: F4, starts: I8, shape: I8, low: F8, size_m: float, facing: I1, first_ns: I8, middles: F4, normals: F8,
    gaps: F8, kind: NDArray[np.uint8], measured: F8,
) -> None:  # fmt: skip
    local, side = np.empty((_MOST_POINTS, 3)), np.empty(_MOST_POINTS)
    stamp = np.empty(_MOST_POINTS, np.int64)
    for i in range(len(middles)):
        axes = _axes(normals[i])
        n = _gathered(
            points, starts, shape, low, size_m, facing, first_ns, middles[i], axes, local, side, stamp
        )
        if n < LEAST_POINTS:
            continue
        _sharpened(local[:n])
        kind[i] = _judged(local[:n], side[:n], stamp[:n], gaps, measured[i])


@kernel
def _axes(normal: F8) -> F8:
    """Rows: the normal, along the wall, up the wall."""
    axes = np.empty((3, 3))
    level = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    axes[0] = normal
    axes[1, 0], axes[1, 1], axes[1, 2] = -normal[1] / level, normal[0] / level, 0.0
    axes[2, 0] = -normal[2] * axes[1, 1]
    axes[2, 1] = normal[2] * axes[1, 0]
    axes[2, 2] = normal[0] * axes[1, 1] - normal[1] * axes[1, 0]
    return axes


@kernel
def _gathered(
    points: F4, starts: I8, shape: I8, low: F8, size_m: float, facing: I1, first_ns: I8, middle: F4, axes: F8,
    local: F8, side: F8, stamp: I8,
) -> int:  # fmt: skip
    """Fill what lies within the patch: places along the axes (n, 3), +1 or -1 for the side it was seen from, stamps."""
    n = 0
    cx: Any = np.int64(np.floor((middle[0] - low[0]) / size_m))
    cy: Any = np.int64(np.floor((middle[1] - low[1]) / size_m))
    first_y, last_y = max(cy - REACH, 0), min(cy + REACH + 1, shape[1])
    for gx in range(max(cx - REACH, 0), min(cx + REACH + 1, shape[0])):
        for j in range(starts[gx * shape[1] + first_y], starts[gx * shape[1] + last_y]):
            x, y, z = points[j, 0] - middle[0], points[j, 1] - middle[1], points[j, 2] - middle[2]
            if x * x + y * y + z * z > RADIUS_M * RADIUS_M or n == _MOST_POINTS:
                continue
            depth = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
            if abs(depth) > DEPTH_M:
                continue
            local[n, 0] = depth
            local[n, 1] = axes[1, 0] * x + axes[1, 1] * y
            local[n, 2] = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
            along = axes[0, 0] * facing[j, 0] + axes[0, 1] * facing[j, 1] + axes[0, 2] * facing[j, 2]
            side[n] = np.sign(along)
            stamp[n] = first_ns[j]
            n += 1
    return n


@kernel
def _sharpened(local: F8) -> None:
    """Turn the normal, first sideways then up, to where the distances along it fall into the fewest bins."""
    some = local[:: max(len(local) // ENOUGH_POINTS, 1)]
    for axis in range(1, 3):
        around, best = 0, -1.0
        for step in range(-STEPS, STEPS + 1, 2):
            sharp = _sharpness(some, axis, np.tan(step * STEP_RAD))
            if sharp > best:
                best, around = sharp, step
        turned = around
        for step in (around - 1, around + 1):
            sharp = _sharpness(some, axis, np.tan(step * STEP_RAD))
            if sharp > best:
                best, turned = sharp, step
        slope = np.tan(turned * STEP_RAD)
        for n in range(len(local)):
            local[n, 0] -= slope * local[n, axis]


@kernel
def _sharpness(local: F8, axis: int, slope: float) -> float:
    """Sum of the squares of a histogram of distances."""
    bins = np.zeros(_BINS + 1)
    for n in range(len(local)):
        place = (local[n, 0] - slope * local[n, axis] + DEPTH_M) / BIN_M
        if 0.0 <= place < _BINS:
            left = int(place)
            bins[left] += left + 1.0 - place
            bins[left + 1] += place - left
    return float((bins * bins).sum())


@kernel
def _judged(local: F8, side: F8, stamp: I8, gaps: F8, measured: F8) -> int:
    measured[THICKNESS] = _thickness(np.sort(local[:, 0].copy()))
    heights = _histogram(local)
    first = int(np.argmax(heights))
    second, valley = _second_peak(heights, first, gaps)
    low, high = _members(local, first, second, valley)
    if not _large(local, low):
        return Patch.NONE
    if second < 0 or not _large(local, high) or not _behind_each_other(local, low, high):
        return Patch.SINGLE
    if min(low.sum(), high.sum()) < LEAST_SHARE * len(local):
        return Patch.SINGLE
    measured[GAP] = abs(local[high, 0].mean() - local[low, 0].mean())
    measured[APART] = abs(np.median(stamp[high] - stamp[0]) - np.median(stamp[low] - stamp[0])) * 1e-9
    if not gaps[0] <= measured[GAP] <= gaps[1]:
        return Patch.SINGLE
    inner, outer = (low, high) if first < second else (high, low)
    if side[inner].mean() < -OUTWARDS and side[outer].mean() > OUTWARDS:
        return Patch.TWO_SIDED
    return Patch.DOUBLE


@kernel
def _thickness(depth: F8) -> float:
    """Of the thinnest slab that holds two thirds of the points; `depth` ascends."""
    span = int(np.ceil(HELD * len(depth))) - 1
    thinnest = np.inf
    for n in range(len(depth) - span):
        thinnest = min(thinnest, depth[n + span] - depth[n])
    return float(thinnest)


@kernel
def _histogram(local: F8) -> F8:
    """Points per bin of distance, smoothed by a quarter, a half, a quarter."""
    bins = np.zeros(_BINS + 2)
    for n in range(len(local)):
        place = (local[n, 0] + DEPTH_M) / BIN_M
        if 0.0 <= place < _BINS:
            bins[int(place) + 1] += 1.0
    return 0.25 * bins[:-2] + 0.5 * bins[1:-1] + 0.25 * bins[2:]


@kernel
def _second_peak(heights: F8, first: int, gaps: F8) -> tuple[Int, Int]:
    """Bins of the highest peak beyond a clear valley and within the gaps, and of the valley; -1 where there is none."""
    best, where, valley = 0.0, -1, -1
    least, most = max(int(gaps[0] / BIN_M), 2), int(np.ceil(gaps[1] / BIN_M))
    for towards in (-1, 1):
        lowest = first
        for step in range(1, most + 1):
            at = first + towards * step
            if at < 0 or at >= len(heights):
                break
            if heights[at] < heights[lowest]:
                lowest = at
            clear = heights[lowest] <= DEEPEST_VALLEY * heights[at]
            above = heights[at] - heights[lowest] >= SIGMAS * np.sqrt(0.375 * (heights[at] + heights[lowest]))
            if step >= least and clear and above and heights[at] > best:
                best, where, valley = heights[at], at, lowest
    return where, valley


@kernel
def _members(local: F8, first: Int, second: Int, valley: Int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points belong to the highest peak, and to the second: near it and on its side of the valley."""
    one, two = np.zeros(len(local), np.bool_), np.zeros(len(local), np.bool_)
    for n in range(len(local)):
        at = int(np.floor((local[n, 0] + DEPTH_M) / BIN_M))
        beyond = second >= 0 and ((at > valley) if second > valley else (at < valley))
        one[n] = not beyond and abs(at - first) <= HALF_LAYER
        two[n] = beyond and abs(at - second) <= HALF_LAYER
    return one, two


@kernel
def _large(local: F8, rows: NDArray[np.bool_]) -> bool:
    """Whether a layer is a surface: wide and high."""
    if rows.sum() < 10:
        return False
    return _extent(local, rows, 1) and _extent(local, rows, 2)


@kernel
def _extent(local: F8, rows: NDArray[np.bool_], axis: int) -> bool:
    """Whether the middle nine tenths of the points reach far enough along an axis."""
    steps = np.zeros(_STEPS, np.int64)
    total = 0
    for n in range(len(local)):
        if rows[n]:
            steps[min(max(int((local[n, axis] + RADIUS_M) / STEP_M), 0), _STEPS - 1)] += 1
            total += 1
    low, high, below = -1, -1, 0
    for k in range(_STEPS):
        below += steps[k]
        if low < 0 and below > 0.05 * total:
            low = k
        if high < 0 and below >= 0.95 * total:
            high = k
    return (high - low) * STEP_M >= 0.8 * LEAST_EXTENT_M


@kernel
def _behind_each_other(local: F8, low: NDArray[np.bool_], high: NDArray[np.bool_]) -> bool:
    """Whether two layers cover the same part of the patch, and not too small a part."""
    counts = np.zeros((2, _CELLS * _CELLS))
    for n in range(len(local)):
        if low[n] or high[n]:
            column = min(max(int((local[n, 1] + RADIUS_M) / CELL_M), 0), _CELLS - 1)
            row = min(max(int((local[n, 2] + RADIUS_M) / CELL_M), 0), _CELLS - 1)
            counts[1 if high[n] else 0, row * _CELLS + column] += 1.0
    cells = ((counts[0] + counts[1]) > 0).sum()
    n_low, n_high = counts[0].sum(), counts[1].sum()
    few, many = (counts[1], counts[0]) if n_high < n_low else (counts[0], counts[1])
    likely = (1.0 - np.exp(-n_low / cells)) * (1.0 - np.exp(-n_high / cells))
    spread = ((few > 0) & (many > 0)).sum() / cells
    covered = few[many > 0].sum() / max(few.sum(), 1.0)
    overlap = covered / (1.0 - np.exp(-max(n_low, n_high) / cells))
    return bool(overlap >= LEAST_OVERLAP and spread >= LEAST_SPREAD * likely)
