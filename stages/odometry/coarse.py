"""Coarse search: where a scan fits a local map when nothing tells how it moved.

Correlative matching (Olson, "Real-time correlative scan matching", ICRA 2009) of the scan's points on a 3-D occupancy of
the map, for many rotations and all translations of a window. Blocks of translations are looked at in the order of an
upper bound of their score, from grids in which every cell holds the greatest value of the block that begins there
(Hess et al., "Real-time loop closure in 2D LIDAR SLAM", ICRA 2016): the best cells are found as by trying all of them.
Nothing is drawn by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from scanloom.stages.geometry.voxels import Int
from scanloom.stages.odometry.poses import apart

U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

CELL_M = 0.5
BLOCK, HALF_BLOCK = 4, 2
"""Cells per edge of a block of translations, and of the eight blocks it is divided into."""
HALF_WIDTH_M, HALF_HEIGHT_M = 48.0, 12.0
UPRIGHT, NEAR_UPRIGHT, FLAT = 64, 32, 4
"""Value of a cell that holds part of something upright, of a cell beside one, and of a cell of flat ground: the ground
fits everywhere and so tells nothing about where the scan is."""
UPRIGHT_CELLS = 2
MOST_POINTS = 500
MOST_BLOCKS = 4000
LEAST_OF_BEST = 0.7
"""Proposals that score less than this share of the best are not followed."""
DISTINCT_M, DISTINCT_RAD = 1.2, np.radians(6.0)


@dataclass(frozen=True)
class Window:
    """What is searched: turns (k, 3), rad, and translations up to `reach_m`, `rise_m` in the plane and across it."""

    turns_rad: F8
    reach_m: float
    rise_m: float


@dataclass(frozen=True)
class Proposal:
    """A pose (4, 4) of the scan in the map, and its score: the mean value of the cells its points fall into, 0 to 1."""

    T_map_scan: F8
    score: float


def headings(most_rad: float, step_rad: float = float(np.radians(2.5))) -> F8:
    """Turns (k, 3) about z up to `most_rad` to either side, the smallest first."""
    steps = int(np.ceil(min(most_rad, np.pi) / step_rad))
    yaw = np.array([0.0, *(sign * k * step_rad for k in range(1, steps + 1) for sign in (1, -1))])
    yaw = yaw[np.abs(yaw) < np.pi + 1e-9]
    return np.column_stack((np.zeros((len(yaw), 2)), yaw))


def rotations(most_rad: float, step_rad: float = float(np.radians(7.0))) -> F8:
    """Turns (k, 3) about any axis up to `most_rad`, on a cubic lattice of rotation vectors, the smallest first."""
    steps = int(np.ceil(most_rad / step_rad))
    axis = step_rad * np.arange(-steps, steps + 1)
    turns = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    size = np.linalg.norm(turns, axis=1)
    order = np.argsort(size, kind="stable")
    near: F8 = turns[order][size[order] <= most_rad + 1e-9]
    return near


def propose(
    points_map: F8, points_scan: F8, T_map_scan: F8, R_up_map: F8, window: Window, most: int = 4
) -> list[Proposal]:
    """The best poses of a scan around an expected one, best first, each apart from the better ones.

    Parameters
    ----------
    points_map : (n, 3) points of the map, m.
    points_scan : (m, 3) points of the scan in the LiDAR frame, m.
    T_map_scan : (4, 4) expected pose; translations and turns of `window` are counted from it.
    R_up_map : (3, 3) rotation of the map's frame into one with z up, in which `window` is meant.
    """
    R_scan, center = R_up_map @ T_map_scan[:3, :3], R_up_map @ T_map_scan[:3, 3]
    some = _some(points_scan)
    grid = occupancy(points_map @ R_up_map.T - center)
    if not len(some) or not grid.any():
        return []
    halves = _greatest(grid, HALF_BLOCK, 1)
    blocks = _greatest(halves, HALF_BLOCK, HALF_BLOCK)
    cells = np.stack([_cells(some @ (so3_exp(w) @ R_scan).T) for w in window.turns_rad])
    wide, high = (max(1, int(np.ceil(m / (CELL_M * BLOCK)))) for m in (window.reach_m, window.rise_m))
    bounds = np.empty((len(cells), 2 * wide, 2 * wide, 2 * high), np.int64)
    _bound_blocks(cells, blocks, wide, high, bounds)
    found: list[Proposal] = []
    full, best = UPRIGHT * len(some), np.zeros(4, np.int64)
    for at in np.argsort(-bounds.ravel(), kind="stable")[:MOST_BLOCKS]:
        turn, i, j, k = np.unravel_index(at, bounds.shape)
        least = full * _least(found, most)
        if bounds[turn, i, j, k] <= least:
            break
        corner = BLOCK * (i - wide), BLOCK * (j - wide), BLOCK * (k - high)
        if _best_in_block(cells[turn], grid, halves, *corner, int(least), best):
            T = pose(so3_exp(window.turns_rad[turn]) @ R_scan, CELL_M * best[1:] + center)
            T[:3] = R_up_map.T @ T[:3]
            _keep(found, Proposal(T, float(best[0] / full)), most)
    return found


def occupancy(points: F8) -> U1:
    """Values (nx, ny, nz) of the cells around the origin, z up."""
    half = np.array([HALF_WIDTH_M, HALF_WIDTH_M, HALF_HEIGHT_M])
    inside = points[(np.abs(points) < half).all(axis=1)]
    grid = np.zeros(np.round(2 * half / CELL_M).astype(int), np.uint8)
    _fill(np.floor((inside + half) / CELL_M).astype(np.int64), grid)
    return grid


def _some(points: F8) -> F8:
    """Points of the scan that may fall into the grid, evenly thinned."""
    near = points[(points**2).sum(axis=1) < HALF_WIDTH_M**2]
    some: F8 = near[:: max(1, -(-len(near) // MOST_POINTS))]
    return some


def _cells(points: F8) -> I4:
    half = np.array([HALF_WIDTH_M, HALF_WIDTH_M, HALF_HEIGHT_M])
    cells: I4 = np.floor((points + half) / CELL_M).astype(np.int32)
    return cells


def _least(found: list[Proposal], most: int) -> float:
    """Score that a further proposal must exceed."""
    if not found:
        return 0.0
    return max(LEAST_OF_BEST * found[0].score, found[-1].score if len(found) == most else 0.0)


def _keep(found: list[Proposal], new: Proposal, most: int) -> None:
    """Put a proposal where it belongs, unless a better one is near; worse ones near it go."""
    if any(p.score >= new.score and not _distinct(p, new) for p in found):
        return
    found[:] = [p for p in found if _distinct(p, new)]
    found.insert(next((k for k, p in enumerate(found) if p.score < new.score), len(found)), new)
    del found[most:]


def _distinct(a: Proposal, b: Proposal) -> bool:
    return apart(a.T_map_scan, b.T_map_scan, DISTINCT_M, DISTINCT_RAD)


@kernel
def _fill(cell: I8, grid: U1) -> None:
    """Mark occupied cells: upright where the column holds cells at different heights, flat elsewhere."""
    for n in range(len(cell)):
        grid[cell[n, 0], cell[n, 1], cell[n, 2]] = FLAT
    nx, ny, nz = grid.shape
    for i in range(nx):
        for j in range(ny):
            low, high = nz, -1
            for k in range(nz):
                if grid[i, j, k] != 0:
                    low = min(low, k)
                    high = k
            if high - low >= UPRIGHT_CELLS:
                for k in range(low + 1, high + 1):
                    if grid[i, j, k] != 0:
                        grid[i, j, k] = UPRIGHT
    _widen(grid)


@kernel
def _widen(grid: U1) -> None:
    """Cells beside an upright one, in the plane, count half: the true offset lies between cells."""
    nx, ny, nz = grid.shape
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(nz):
                if grid[i, j, k] < NEAR_UPRIGHT and (
                    grid[i - 1, j, k] == UPRIGHT or grid[i + 1, j, k] == UPRIGHT
                    or grid[i, j - 1, k] == UPRIGHT or grid[i, j + 1, k] == UPRIGHT
                ):  # fmt: skip
                    grid[i, j, k] = NEAR_UPRIGHT


def _greatest(grid: U1, cells: int, apart: int) -> U1:
    """Greatest of `cells` values at distances `apart` from each cell on, along each axis."""
    out = grid
    for axis in range(3):
        reach = out.copy()
        for step in range(apart, cells * apart, apart):
            head, tail = [slice(None)] * 3, [slice(None)] * 3
            head[axis], tail[axis] = slice(None, -step), slice(step, None)
            reach[tuple(head)] = np.maximum(reach[tuple(head)], out[tuple(tail)])
        out = reach
    return out


@kernel
def _score(cells: I4, grid: U1, di: Int, dj: Int, dk: Int) -> Int:
    """Sum of the values of the cells that the points fall into when shifted; also from before the grid's first cells."""
    nx, ny, nz = grid.shape
    total = np.int64(0)
    for n in range(len(cells)):
        i, j, k = cells[n, 0] + di, cells[n, 1] + dj, cells[n, 2] + dk
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
            total += grid[i, j, k]
    return total


@kernel
def _bound_blocks(cells: I4, blocks: U1, wide: Int, high: Int, bounds: I8) -> None:
    """Upper bound of the score in every block of translations, for every turn."""
    for turn in range(cells.shape[0]):
        for i in range(2 * wide):
            for j in range(2 * wide):
                for k in range(2 * high):
                    bounds[turn, i, j, k] = _score(
                        cells[turn], blocks, BLOCK * (i - wide), BLOCK * (j - wide), BLOCK * (k - high)
                    )


@kernel
def _best_in_block(cells: I4, grid: U1, halves: U1, i: Int, j: Int, k: Int, least: Int, best: I8) -> bool:
    """Score and translation, in cells, of the best cell of a block that scores more than `least`; False without one."""
    best[0] = least
    found = False
    for a in range(i, i + BLOCK, HALF_BLOCK):
        for b in range(j, j + BLOCK, HALF_BLOCK):
            for c in range(k, k + BLOCK, HALF_BLOCK):
                if _score(cells, halves, a, b, c) <= best[0]:
                    continue
                for di in range(a, a + HALF_BLOCK):
                    for dj in range(b, b + HALF_BLOCK):
                        for dk in range(c, c + HALF_BLOCK):
                            total = _score(cells, grid, di, dj, dk)
                            if total > best[0]:
                                best[0], best[1], best[2], best[3] = total, di, dj, dk
                                found = True
    return found
