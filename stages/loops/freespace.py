"""Free space: what a scan saw through cannot be there. It tells places apart that look alike, such as two decks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

CELL_RAD = np.radians(2.0)
COLUMNS, ROWS = 180, 60
"""Cells of 2 degrees all around, and from 60 degrees below to 60 above the horizon."""
LOWEST_RAD = np.radians(-60.0)
MARGIN_M, MARGIN_SHARE = 1.0, 0.1
FARTHEST_M = 40.0


def seen_through(scan: F8, points: F8) -> float:
    """Share of `points` (n, 3) that lie well before all returns of `scan` (k, 3) around their direction.

    Both in the frame of the scan's LiDAR, m. Directions without a return tell nothing; 0 when no point can be tested.
    """
    image = np.full((ROWS, COLUMNS), np.inf)
    _nearest_returns(scan, image)
    tested, through = _count(points, image)
    return through / tested if tested else 0.0


@kernel
def _cell(x: float, y: float, z: float) -> tuple[int, int, float]:
    r = np.sqrt(x * x + y * y + z * z)
    row = int(np.floor((np.arcsin(z / max(r, 1e-6)) - LOWEST_RAD) / CELL_RAD))
    column = int(np.floor((np.arctan2(y, x) + np.pi) / CELL_RAD)) % COLUMNS
    return row, column, r


@kernel
def _nearest_returns(scan: F8, image: NDArray[np.float64]) -> None:
    for n in range(len(scan)):
        row, column, r = _cell(scan[n, 0], scan[n, 1], scan[n, 2])
        if 0 <= row < ROWS and r < image[row, column]:
            image[row, column] = r


@kernel
def _count(points: F8, image: NDArray[np.float64]) -> tuple[int, int]:
    tested, through = 0, 0
    for n in range(len(points)):
        row, column, r = _cell(points[n, 0], points[n, 1], points[n, 2])
        if not (1 <= row < ROWS - 1) or r > FARTHEST_M or not np.isfinite(image[row, column]):
            continue
        nearest = np.inf
        for u in range(row - 1, row + 2):
            for v in range(column - 1, column + 2):
                nearest = min(nearest, image[u, v % COLUMNS])
        tested += 1
        through += nearest > r + max(MARGIN_M, MARGIN_SHARE * r)
    return tested, through
