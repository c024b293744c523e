"""The ground under a scan: its height on a polar grid, for level and sloping roads, 16 to 128 beams.

In each sector the lowest points are followed outwards, as long as they continue the slope so far (the idea of
Himmelsbach et al. 2010: lines in polar segments). A cell with vertical extent, a wall or a car, must continue it more
closely than a flat one. The walk starts from a plane fitted around the sensor, which gives its height and tilt.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.columns import standing
from scanloom.stages.geometry.descent import solve
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.polar_grid import BINS, SECTORS, center, direction, extent, levelled
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I2 = NDArray[np.int16]

SEED_M = 12.0
SEED_CELLS = 12
HIGHEST_GROUND_M = -0.15
"""The ground under the sensor is at least this far below it."""
STEEPEST = 0.2
FLAT_M = 0.25
REACH_M = 8.0
"""Farthest beyond the last cell with ground that it is continued."""
STRANGE_M = 0.4
"""A cell of ground this much above most of those around it is something else; twice that beyond 50 m."""
FOOT_STEP_M = 0.08
"""An upright cell whose foot is this much above most of the flat ones around it shows no ground."""
EDGE_CELLS = 2
"""So many cells must continue what lies below an edge."""
KERB_M = 2.0
FIT_GATES_M = (0.5, 0.3, 0.2, 0.15)
FLOORED_SECTORS = 60
"""A floor is seen in a third of all directions."""
FOOT_M = 0.05
"""Under something that stands on it the ground ends here above its height: what the noise of a range explains."""
FIRST, UNKNOWN = np.int16(0), np.float32(np.nan)


def ground_mask(x_m: F4, y_m: F4, z_m: F4, usable: B1, R_level_lidar: F8, height_m: float) -> B1:
    """Which points (n,) are ground: within `height_m` above, or twice that below, the ground of their cell.

    Parameters
    ----------
    x_m, y_m, z_m : (n,) coordinates in the LiDAR frame, m.
    usable : (n,) points that may show where the ground is; the others are never ground.
    R_level_lidar : (3, 3) turns the LiDAR's axes into the vehicle's, z up.

    Feet belong to what stands on them: with other points right above it a point is ground only within FOOT_M.
    Without ground around the sensor nothing is ground. A sensor that hangs upside down without saying so has its ground
    above it.
    """
    cell, forward, left, up = levelled(x_m, y_m, z_m, usable, R_level_lidar)
    lowest, highest = extent(cell, up)
    plane = seed_plane(lowest)
    if hangs(lowest, highest, plane):
        up, lowest, highest = -up, -highest, -lowest
        plane = seed_plane(lowest)
    if plane is None:
        return np.zeros(len(x_m), np.bool_)
    height = _without_strangers(_follow(lowest, highest, plane), highest)
    slope = _fill(height, plane[0])
    above = _above(cell, forward, left, up, height, slope)
    return _near(above, standing(forward, left, above, height_m), height_m, min(FOOT_M, height_m))


def seed_plane(lowest: F8) -> F8 | None:
    """Plane (3,) z = a + b x + c y around the sensor from the lowest heights of the cells, or None without ground."""
    x, y = _seed_cells()
    around = lowest[:, : x.shape[1]]
    ground = around < HIGHEST_GROUND_M
    if np.count_nonzero(ground) < SEED_CELLS:
        return None
    z = around[ground]
    start = z.min() - 0.1
    count = np.convolve(np.bincount(((z - start) * 10.0).astype(np.int64)), (1, 2, 1), mode="same")
    plane = np.array([start + 0.1 * np.argmax(count) + 0.05, 0.0, 0.0])
    fitted: F8 = _fitted(x[ground], y[ground], z, plane)
    return fitted


@kernel
def _fitted(x: F8, y: F8, z: F8, plane: F8) -> F8:
    """The plane (3,) z = a + b x + c y fitted to what lies ever closer to it."""
    for gate in FIT_GATES_M:
        A, b, count = np.zeros((3, 3)), np.zeros(3), 0
        for i in range(len(z)):
            if abs(z[i] - (plane[0] + plane[1] * x[i] + plane[2] * y[i])) < gate:
                row = (1.0, x[i], y[i])
                for j in range(3):
                    b[j] += row[j] * z[i]
                    for k in range(3):
                        A[j, k] += row[j] * row[k]
                count += 1
        if count < SEED_CELLS:
            break
        found = solve(A, b)
        if np.sqrt(found[1] ** 2 + found[2] ** 2) < STEEPEST:
            plane = found
    return plane


def hangs(lowest: F8, highest: F8, plane: F8 | None) -> bool:
    """Whether there is no ground below the sensor, whose plane (3,) was sought, but a floor all around above it."""
    below = _floored(lowest, highest, plane)
    if below >= FLOORED_SECTORS:
        return False
    above = _floored(-highest, -lowest, seed_plane(-highest))
    return above >= FLOORED_SECTORS and above > 3 * below


def _floored(lowest: F8, highest: F8, plane: F8 | None) -> int:
    """Sectors in which flat cells, and more than one, lie on the plane."""
    if plane is None:
        return 0
    x, y = _seed_cells()
    near = slice(None), slice(x.shape[1])
    low, high = lowest[near], highest[near]
    with np.errstate(invalid="ignore"):
        on = (high - low < FLAT_M) & (
            np.abs(low - (plane[0] + plane[1] * x + plane[2] * y)) < FIT_GATES_M[-1]
        )
    return int(np.count_nonzero(on.sum(axis=1) > 1))


@cache
def _seed_cells() -> tuple[F8, F8]:
    """x and y (SECTORS, bins nearer than SEED_M) of the middle of each cell, m."""
    towards = np.array([direction(s) for s in range(SECTORS)])
    away = np.array([center(b) for b in range(BINS) if center(b) < SEED_M])
    return np.outer(towards[:, 0], away), np.outer(towards[:, 1], away)


@kernel
def _follow(lowest: F8, highest: F8, plane: F8) -> F8:
    """Height (SECTORS, BINS), m, of the ground in the cells whose lowest point continues it; NaN in the others."""
    height = np.full((SECTORS, BINS), np.nan)
    for s in range(SECTORS):
        ux, uy = direction(s)
        z, r, k = plane[0], 0.0, plane[1] * ux + plane[2] * uy
        for b in range(BINS):
            if not np.isfinite(lowest[s, b]):
                continue
            step = center(b) - r
            rise = lowest[s, b] - (z + k * step)
            reach = min(step, 4.0 if r > 0.0 else 2.0)  # near the sensor the plane tells more
            flat = highest[s, b] - lowest[s, b] < FLAT_M
            above = 0.12 + 0.1 * reach if flat else 0.1 + 0.03 * reach
            if rise < -0.25 - 0.1 * reach:
                if not _goes_on(lowest[s], b):
                    continue
                k, rise = 0.0, 0.0
            if rise > above:
                continue
            k = min(max(k + rise / (step + 4.0), -STEEPEST), STEEPEST)
            z, r = lowest[s, b], center(b)
            height[s, b] = z
        _step_up(lowest[s], highest[s], height[s])
    return height


@kernel
def _goes_on(lowest: F8, b: int) -> bool:
    """Whether what lies deeper than the ground so far is ground beyond an edge: the next cells outwards continue it."""
    alike, last = 0, b
    for c in range(b + 1, min(b + 5, BINS)):
        if np.isfinite(lowest[c]):
            step = center(c) - center(last)
            if abs(lowest[c] - lowest[last]) > 0.1 + STEEPEST * step:
                return False
            alike, last = alike + 1, c
            if alike == EDGE_CELLS:
                return True
    return False


@kernel
def _step_up(lowest: F8, highest: F8, height: F8) -> None:
    """Adds, in place, the flat cells between a kerb and the ground behind it, which was found only farther out."""
    behind = -1
    for b in range(BINS - 1, -1, -1):
        if np.isfinite(height[b]):
            behind = b
            continue
        if behind < 0 or highest[b] - lowest[b] >= FLAT_M or center(behind) - center(b) >= KERB_M:
            continue
        if abs(lowest[b] - height[behind]) < FOOT_STEP_M:
            height[b], behind = lowest[b], b


@kernel
def _without_strangers(height: F8, highest: F8) -> F8:
    """The same without cells that lie higher than most with ground around them, or, if upright, than most flat ones."""
    out = height.copy()
    for s in range(SECTORS):
        for b in range(BINS):
            if not np.isfinite(height[s, b]):
                continue
            limit = height[s, b] - STRANGE_M - (0.0 if b < 70 else STRANGE_M)
            upright = highest[s, b] - height[s, b] >= FLAT_M
            around, lower, flat, below = 0, 0, 0, 0
            for ds in range(-2, 3):
                t = s + ds
                t = t + SECTORS if t < 0 else (t - SECTORS if t >= SECTORS else t)
                for db in range(-2, 3):
                    c = min(max(b + db, 0), BINS - 1)
                    other = height[t, c]
                    if np.isfinite(other):
                        around += 1
                        lower += other < limit
                        if highest[t, c] - other < FLAT_M:
                            flat += 1
                            below += other < height[s, b] - FOOT_STEP_M
            if 2 * lower > around or (around < 3 and b >= 40) or (upright and flat >= 2 and 2 * below > flat):
                out[s, b] = np.nan
    return out


@kernel
def _fill(height: F8, at_sensor: float) -> F8:
    """Bridges cells without ground, in place, and continues it for a while; returns the slopes outwards."""
    slope = np.zeros((SECTORS, BINS))
    for s in range(SECTORS):
        z, r, k, previous = at_sensor, 0.0, 0.0, -1
        for b in range(BINS):
            if not np.isfinite(height[s, b]):
                continue
            k = (height[s, b] - z) / (center(b) - r)
            for m in range(previous + 1, b):
                height[s, m] = z + k * (center(m) - r)
            z, r, previous = height[s, b], center(b), b
        k = min(max((z - at_sensor) / max(r, 1.0), -STEEPEST), STEEPEST)
        for m in range(previous + 1, BINS):
            if center(m) > r + REACH_M:
                break
            height[s, m] = z + k * (center(m) - r)
        for b in range(1, BINS - 1):
            k = (height[s, b + 1] - height[s, b - 1]) / (center(b + 1) - center(b - 1))
            slope[s, b] = min(max(k, -STEEPEST), STEEPEST) if np.isfinite(k) else 0.0
    return slope


@kernel
def _above(cell: I2, forward: F4, left: F4, up: F4, height: F8, slope: F8) -> F4:
    """How far each point (n,) is above the ground, m; NaN where that is not known."""
    start, rise = np.empty(SECTORS * BINS, np.float32), np.empty(SECTORS * BINS, np.float32)
    for s in range(SECTORS):
        for b in range(BINS):
            start[s * BINS + b], rise[s * BINS + b] = height[s, b] - slope[s, b] * center(b), slope[s, b]
    out = np.empty(len(cell), np.float32)
    for i in range(len(cell)):
        away, k = np.sqrt(forward[i] * forward[i] + left[i] * left[i]), max(cell[i], FIRST)
        known = up[i] - (start[k] + rise[k] * away)
        out[i] = known if cell[i] >= 0 else UNKNOWN
    return out


@kernel
def _near(above: F4, under: B1, tolerance: float, foot: float) -> B1:
    out = np.zeros(len(above), np.bool_)
    for i in range(len(above)):
        out[i] = -2.0 * tolerance < above[i] < (foot if under[i] else tolerance)
    return out
