"""Points that stand alone: fewer neighbours than a solid surface would give at their range.

The reach in which neighbours are counted grows with the range as the spacing of the beams does (the idea of dynamic
radius outlier removal, Charron et al. 2018). Most points have them right before and after themselves in the order they
were measured in; for the rest the range image is looked through, in a box along their ray, instead of a search tree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import RangeImage
from scanloom.stages.geometry.voxels import Float, Int

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I4 = NDArray[np.int32]

ALONGSIDE = 3
"""Points before and after a point, in their order, that are looked at before the image."""

FARTHEST_ROWS, FARTHEST_COLUMNS = 16, 64
"""Of the image around a point, looked through at most."""


def isolated(
    image: RangeImage, x_m: F4, y_m: F4, z_m: F4, *, reach_m: float, reach_rad: float, least_neighbours: int
) -> B1:
    """Which points (n,) of an image have fewer than `least_neighbours` others around them; points not drawn never do.

    Parameters
    ----------
    image : of these points.
    x_m, y_m, z_m : (n,) coordinates in the LiDAR frame, m.
    reach_m : half of the edge of the box in which neighbours count, close to the sensor.
    reach_rad : the same over range, from where that is more than `reach_m`.
    """
    row_rad = float(np.median(np.diff(image.elevation_rad))) if len(image.elevation_rad) > 1 else np.pi
    few = _few_alongside(
        image.cell, x_m, y_m, z_m, np.float32(reach_m), np.float32(reach_rad), least_neighbours
    )
    return _lonely(
        few, image.cell, x_m, y_m, z_m, image.range_m, row_rad, image.column_rad, reach_m, reach_rad, least_neighbours
    )  # fmt: skip


@kernel
def _few_alongside(cell: I4, x: F4, y: F4, z: F4, reach_m: Float, reach_rad: Float, least: int) -> B1:
    """Which points (n,) have fewer neighbours than that among those next to them in order."""
    reach, linked = np.empty(len(x), np.float32), np.zeros(len(x), np.int8)
    count, out = np.zeros(len(x), np.int8), np.empty(len(x), np.bool_)
    for n in range(len(x)):
        r = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        reach[n] = max(reach_m, reach_rad * r) if cell[n] >= 0 else np.float32(-1.0)
    for d in range(1, ALONGSIDE + 1):
        for n in range(len(x) - d):  # nothing is skipped, so that the compiler takes several points at once
            most = max(abs(x[n + d] - x[n]), abs(y[n + d] - y[n]), abs(z[n + d] - z[n]))
            linked[n] = np.int8((most < reach[n]) & (cell[n + d] >= 0))
        for n in range(len(x) - d):
            count[n] += linked[n]
        for n in range(d, len(x)):
            count[n] += linked[n - d]
    for n in range(len(x)):
        out[n] = (cell[n] >= 0) & (count[n] < least)
    return out


@kernel
def _lonely(
    few: B1, cell: I4, x: F4, y: F4, z: F4, range_m: F4, row_rad: float, column_rad: float, reach_m: float,
    reach_rad: float, least: int,
) -> B1:  # fmt: skip
    rows, columns = range_m.shape
    out = np.zeros(len(x), np.bool_)
    for n in range(len(x)):
        if not few[n]:
            continue
        r = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        reach = np.float32(max(reach_m, reach_rad * r))
        up = min(int(reach / (r * row_rad) + 0.5), FARTHEST_ROWS)
        aside = min(int(reach / (r * column_rad) + 0.5), FARTHEST_COLUMNS, (columns - 1) // 2)
        v, u = cell[n] // columns, cell[n] % columns
        seen = (
            -1 if abs(range_m[v, u] - r) < reach else 0
        )  # the point itself, or one before it, is in its cell
        for i in range(max(v - up, 0), min(v + up + 1, rows)):
            row, low, high = range_m[i], u - aside, u + aside + 1
            seen += _near(row[max(low, 0) : min(high, columns)], r, reach)
            if low < 0:
                seen += _near(row[low + columns :], r, reach)
            if high > columns:
                seen += _near(row[: high - columns], r, reach)
            if seen >= least:
                break
        out[n] = seen < least
    return out


@kernel
def _near(ranges: F4, r: Float, reach: Float) -> Int:
    """How many of some cells hold something at this range, give or take the reach."""
    count = np.int32(0)
    for k in range(len(ranges)):
        count += np.int32((abs(ranges[k] - r) < reach) & (ranges[k] > 0.0))
    return count
