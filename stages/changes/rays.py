"""What one scan says of points of the old map: seen through, confirmed, or nothing.

The scan becomes an image of directions, with the nearest return of each cell in it. A point is asked at the returns of
the nine cells around its direction: of each, how far from the point its ray runs and where it ends.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

I4 = NDArray[np.int32]
F4 = NDArray[np.float32]
ROW_RAD = np.radians(1.4)
"""A little more than the beams of common LiDARs are apart, so that few cells are empty."""
COLUMNS = 512
ROWS = 86
LOWEST_RAD = -0.5 * ROWS * ROW_RAD
"""60 degrees below the horizon."""
NEAREST_M = 1.5


def new_image() -> F8:
    """An image to be filled: range m (infinite without a return), direction (x, y, z), 1 where the return is static."""
    return np.empty((ROWS, COLUMNS, 5))


@kernel
def fill(image: F8, x: F4, y: F4, z: F4, static: NDArray[np.bool_]) -> None:
    """Put the nearest return of every direction into the image; points in the LiDAR frame, m."""
    image[:, :, 0] = np.inf
    for n in range(len(x)):
        px, py, pz = np.float64(x[n]), np.float64(y[n]), np.float64(z[n])
        r = np.sqrt(px * px + py * py + pz * pz)
        if not (r > NEAREST_M):
            continue
        row, column = _cell(px, py, pz, r)
        if 0 <= row < ROWS and r < image[row, column, 0]:
            image[row, column, 0] = r
            image[row, column, 1] = px / r
            image[row, column, 2] = py / r
            image[row, column, 3] = pz / r
            image[row, column, 4] = 1.0 if static[n] else 0.0


@kernel
def _cell(x: float, y: float, z: float, r: float) -> tuple[int, int]:
    row = int(np.floor((np.arcsin(z / r) - LOWEST_RAD) / ROW_RAD))
    column = int(np.floor((np.arctan2(y, x) + np.pi) * (COLUMNS / (2.0 * np.pi)))) % COLUMNS
    return row, column


@kernel
def judge(points: F8, T_lidar_world: F8, image: F8, limits: F8, through: I4, confirming: I4) -> None:
    """Add what the scan says of each of `points` (n, 3) of the map to its counts.

    limits: max_range_m, margin_m, margin_share, ray_m, guard_m, confirm_m.
    """
    R, t = T_lidar_world[:3, :3], T_lidar_world[:3, 3]
    for n in range(len(points)):
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2] + t[0]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2] + t[1]
        z = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2] + t[2]
        r = np.sqrt(x * x + y * y + z * z)
        if r < NEAREST_M or r > limits[0]:
            continue
        said = _said(x, y, z, r, image, limits)
        if said > 0:
            through[n] += 1
        elif said < 0:
            confirming[n] += 1


@kernel
def _said(x: float, y: float, z: float, r: float, image: F8, limits: F8) -> int:
    """1 seen through, -1 confirmed, 0 nothing, of a point in the LiDAR frame."""
    row, column = _cell(x, y, z, r)
    if row < 1 or row >= ROWS - 1:
        return 0
    margin = limits[1] + limits[2] * r
    passed, hidden = False, False
    for u in range(row - 1, row + 2):
        for v in range(column - 1, column + 2):
            ray = image[u, v % COLUMNS]
            if not np.isfinite(ray[0]):
                continue
            along = ray[1] * x + ray[2] * y + ray[3] * z
            beside = np.sqrt(max(r * r - along * along, 0.0))
            off = ray[0] - along
            if ray[4] > 0.0 and beside * beside + off * off < limits[5] * limits[5]:
                return -1
            if ray[0] > r + margin:
                passed = passed or beside < limits[3]
            elif beside < limits[4]:
                hidden = True
    return 1 if passed and not hidden else 0
