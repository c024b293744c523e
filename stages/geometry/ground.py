"""The ground under a scan: its height on a polar grid, for level and sloping roads, 16 to 128 beams.

In each sector the lowest points are followed outwards, as long as they continue the slope so far (the idea of
Himmelsbach et al. 2010: lines in polar segments). A cell with vertical extent, a wall or a car, must continue it more
closely than a flat one. The walk starts from a plane fitted around the sensor, which gives its height and tilt.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I2 = NDArray[np.int16]

SECTORS = 180
NEAR_M, MIDDLE_M, FAR_M = 20.0, 50.0, 120.0
BINS = 40 + 30 + 35
"""Cells of 0.5 m up to 20 m, of 1 m up to 50 m, of 2 m up to 120 m."""
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
FIT_GATES_M = (0.5, 0.3, 0.2, 0.15)


def ground_mask(x_m: F4, y_m: F4, z_m: F4, usable: B1, R_level_lidar: F8, height_m: float) -> B1:
    """Which points (n,) are ground: within `height_m` above, or twice that below, the ground of their cell.

    Parameters
    ----------
    x_m, y_m, z_m : (n,) coordinates in the LiDAR frame, m.
    usable : (n,) points that may show where the ground is; the others are never ground.
    R_level_lidar : (3, 3) turns the LiDAR's axes into the vehicle's, z up.

    Without ground around the sensor nothing is ground.
    """
    cell, outward, level = _cells(x_m, y_m, z_m, usable, R_level_lidar)
    lowest, highest = _extent(cell, level)
    plane = seed_plane(lowest)
    if plane is None:
        return np.zeros(len(x_m), np.bool_)
    height = _without_strangers(_follow(lowest, highest, plane))
    slope = _fill(height, plane[0])
    return _near(cell, outward, level, height, slope, height_m)


def seed_plane(lowest: F8) -> F8 | None:
    """Plane (3,) z = a + b x + c y around the sensor from the lowest heights of the cells, or None without ground."""
    x, y = _seed_cells()
    around = lowest[:, : x.shape[1]]
    ground = around < HIGHEST_GROUND_M
    if np.count_nonzero(ground) < SEED_CELLS:
        return None
    z = around[ground]
    A = np.column_stack((np.ones(len(z)), x[ground], y[ground]))
    start = z.min() - 0.1
    count = np.convolve(np.bincount(((z - start) * 10.0).astype(np.int64)), (1, 2, 1), mode="same")
    plane = np.array([start + 0.1 * np.argmax(count) + 0.05, 0.0, 0.0])
    for gate in FIT_GATES_M:
        near = np.abs(z - A @ plane) < gate
        if np.count_nonzero(near) < SEED_CELLS:
            break
        B = A[near].T
        fitted = np.linalg.lstsq(B @ B.T, B @ z[near], rcond=None)[0]
        if np.hypot(fitted[1], fitted[2]) < STEEPEST:
            plane = fitted
    return plane


@cache
def _seed_cells() -> tuple[F8, F8]:
    """x and y (SECTORS, bins nearer than SEED_M) of the middle of each cell, m."""
    direction = np.array([_direction(s) for s in range(SECTORS)])
    center = np.array([_center(b) for b in range(BINS) if _center(b) < SEED_M])
    return np.outer(direction[:, 0], center), np.outer(direction[:, 1], center)


@kernel
def _bin(r: float) -> int:
    if r < NEAR_M:
        return int(r * 2.0)
    if r < MIDDLE_M:
        return 40 + int(r - NEAR_M)
    return min(70 + int((r - MIDDLE_M) * 0.5), BINS - 1)


@kernel
def _center(b: int) -> float:
    if b < 40:
        return 0.5 * b + 0.25
    if b < 70:
        return NEAR_M + (b - 40) + 0.5
    return MIDDLE_M + 2.0 * (b - 70) + 1.0


@kernel
def _sector(x: float, y: float) -> int:
    """Sector by the angle of a diamond, which rises with the azimuth and needs no arc tangent."""
    norm = abs(x) + abs(y)
    if norm == 0.0:
        return 0
    p = y / norm
    turn = 1.0 + p if x >= 0.0 else 3.0 - p  # from -y in [0, 4)
    return min(int(turn * (0.25 * SECTORS)), SECTORS - 1)


@kernel
def _direction(s: int) -> tuple[float, float]:
    """Unit vector of the middle of a sector."""
    turn = (s + 0.5) * 4.0 / SECTORS
    y = turn - 1.0 if turn < 2.0 else 3.0 - turn
    x = 1.0 - abs(y) if turn < 2.0 else abs(y) - 1.0
    norm = np.sqrt(x * x + y * y)
    return x / norm, y / norm


@kernel
def _cells(x: F4, y: F4, z: F4, usable: B1, R: F8) -> tuple[I2, F4, F4]:
    """For each point (n,) its cell, sector BINS + bin, -1 if it has none; how far beyond the cell's middle, m; its level height, m."""
    cell = np.full(len(x), -1, np.int16)
    outward, level = np.empty(len(x), np.float32), np.empty(len(x), np.float32)
    for i in range(len(x)):
        if not usable[i]:
            continue
        u = R[0, 0] * x[i] + R[0, 1] * y[i] + R[0, 2] * z[i]
        v = R[1, 0] * x[i] + R[1, 1] * y[i] + R[1, 2] * z[i]
        r = np.sqrt(u * u + v * v)
        if r < FAR_M:
            b = _bin(r)
            cell[i] = _sector(u, v) * BINS + b
            outward[i] = r - _center(b)
            level[i] = R[2, 0] * x[i] + R[2, 1] * y[i] + R[2, 2] * z[i]
    return cell, outward, level


@kernel
def _extent(cell: I2, level: F4) -> tuple[F8, F8]:
    """Lowest and highest level height of the points of each cell (SECTORS, BINS), m; inf and -inf if none."""
    lowest, highest = np.full(SECTORS * BINS, np.inf), np.full(SECTORS * BINS, -np.inf)
    for i in range(len(cell)):
        if cell[i] >= 0:
            lowest[cell[i]] = min(lowest[cell[i]], level[i])
            highest[cell[i]] = max(highest[cell[i]], level[i])
    return lowest.reshape(SECTORS, BINS), highest.reshape(SECTORS, BINS)


@kernel
def _follow(lowest: F8, highest: F8, plane: F8) -> F8:
    """Height (SECTORS, BINS), m, of the ground in the cells whose lowest point continues it; NaN in the others."""
    height = np.full((SECTORS, BINS), np.nan)
    for s in range(SECTORS):
        ux, uy = _direction(s)
        z, r, k = plane[0], 0.0, plane[1] * ux + plane[2] * uy
        for b in range(BINS):
            if not np.isfinite(lowest[s, b]):
                continue
            step = _center(b) - r
            rise = lowest[s, b] - (z + k * step)
            reach = min(step, 4.0)
            flat = highest[s, b] - lowest[s, b] < FLAT_M
            above = 0.12 + 0.1 * reach if flat else 0.1 + 0.03 * reach
            if rise > above or rise < -0.25 - 0.1 * reach:
                continue
            k = min(max(k + rise / (step + 4.0), -STEEPEST), STEEPEST)
            z, r = lowest[s, b], _center(b)
            height[s, b] = z
    return height


@kernel
def _without_strangers(height: F8) -> F8:
    """The same without cells that lie higher than most cells with ground around them."""
    out = height.copy()
    for s in range(SECTORS):
        for b in range(BINS):
            if not np.isfinite(height[s, b]):
                continue
            limit = height[s, b] - STRANGE_M - (0.0 if b < 70 else STRANGE_M)
            around, lower = 0, 0
            for ds in range(-2, 3):
                for db in range(-2, 3):
                    other = height[(s + ds) % SECTORS, min(max(b + db, 0), BINS - 1)]
                    if np.isfinite(other):
                        around += 1
                        lower += other < limit
            if 2 * lower > around or (around < 3 and b >= 40):
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
            k = (height[s, b] - z) / (_center(b) - r)
            for m in range(previous + 1, b):
                height[s, m] = z + k * (_center(m) - r)
            z, r, previous = height[s, b], _center(b), b
        k = min(max((z - at_sensor) / max(r, 1.0), -STEEPEST), STEEPEST)
        for m in range(previous + 1, BINS):
            if _center(m) > r + REACH_M:
                break
            height[s, m] = z + k * (_center(m) - r)
        for b in range(1, BINS - 1):
            k = (height[s, b + 1] - height[s, b - 1]) / (_center(b + 1) - _center(b - 1))
            slope[s, b] = min(max(k, -STEEPEST), STEEPEST) if np.isfinite(k) else 0.0
    return slope


@kernel
def _near(cell: I2, outward: F4, level: F4, height: F8, slope: F8, tolerance: float) -> B1:
    out = np.zeros(len(cell), np.bool_)
    heights, slopes = height.ravel(), slope.ravel()
    for i in range(len(cell)):
        if cell[i] >= 0:
            above = level[i] - (heights[cell[i]] + slopes[cell[i]] * outward[i])
            out[i] = -2.0 * tolerance < above < tolerance
    return out
