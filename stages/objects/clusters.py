"""What belongs together in the band of a virtual scan: points whose cells touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

FREE = -1
ALONG_SHARE, ACROSS_SHARE = 0.045, 0.012
"""Points touch that are so far apart per metre of range, along a ray and across it: rays that graze the side of a car are
far apart along it."""
LONGEST_M = 1.2


@kernel
def clusters(band: F4, edge: float, far: float) -> tuple[I4, int]:
    """Number (n,) of the cluster each point belongs to, and how many there are; `far` is the farthest range, m."""
    side = 2 * int(np.ceil(far / edge)) + 1
    grid = np.full((side, side), FREE, np.int32)
    cell = np.empty((len(band), 2), np.int32)
    for n in range(len(band)):
        cell[n, 0] = min(max(int(np.floor(band[n, 0] / edge)) + side // 2, 0), side - 1)
        cell[n, 1] = min(max(int(np.floor(band[n, 1] / edge)) + side // 2, 0), side - 1)
        grid[cell[n, 0], cell[n, 1]] = -2
    stack = np.empty((len(band) + 1, 2), np.int32)
    count = 0
    for n in range(len(band)):
        if grid[cell[n, 0], cell[n, 1]] != -2:
            continue
        _flood(grid, stack, cell[n, 0], cell[n, 1], count, edge)
        count += 1
    label = np.empty(len(band), np.int32)
    for n in range(len(band)):
        label[n] = grid[cell[n, 0], cell[n, 1]]
    return label, count


@kernel
def _flood(grid: I4, stack: I4, a: int, b: int, number: int, edge: float) -> None:
    side = len(grid)
    stack[0, 0], stack[0, 1] = a, b
    grid[a, b] = number
    top = 1
    while top > 0:
        top -= 1
        i, j = stack[top, 0], stack[top, 1]
        x, y = (i - side // 2) * edge, (j - side // 2) * edge
        r = max(np.hypot(x, y), edge)
        along = max(min(ALONG_SHARE * r, LONGEST_M) / edge, 1.5)
        across = max(min(ACROSS_SHARE * r, LONGEST_M) / edge, 1.5)
        reach = int(along)
        for u in range(max(i - reach, 0), min(i + reach + 1, side)):
            for v in range(max(j - reach, 0), min(j + reach + 1, side)):
                if grid[u, v] != -2:
                    continue
                radial = abs((u - i) * x + (v - j) * y) / r
                lateral = abs((v - j) * x - (u - i) * y) / r
                if (radial / along) ** 2 + (lateral / across) ** 2 <= 1.0:
                    grid[u, v] = number
                    stack[top, 0], stack[top, 1] = u, v
                    top += 1


@kernel
def extents(band: F4, label: I4, count: int) -> F8:
    """(count, 6): points, lowest x and y, highest x and y, greatest height of each cluster."""
    out = np.empty((count, 6))
    out[:, 0] = 0.0
    out[:, 1:3] = np.inf
    out[:, 3:6] = -np.inf
    for n in range(len(band)):
        if label[n] < 0:
            continue
        row = out[label[n]]
        row[0] += 1.0
        row[1], row[2] = min(row[1], band[n, 0]), min(row[2], band[n, 1])
        row[3], row[4] = max(row[3], band[n, 0]), max(row[4], band[n, 1])
        row[5] = max(row[5], band[n, 3])
    return out


@kernel
def grouped(owner: I4, count: int) -> tuple[I4, I4]:
    """Points by owner: first of each in the order (count + 1,), and the order; points without owner are left out."""
    starts = np.zeros(count + 1, np.int32)
    for n in range(len(owner)):
        if owner[n] >= 0:
            starts[owner[n] + 1] += 1
    for k in range(count):
        starts[k + 1] += starts[k]
    following = starts[:-1].copy()
    order = np.empty(starts[count], np.int32)
    for n in range(len(owner)):
        if owner[n] >= 0:
            order[following[owner[n]]] = n
            following[owner[n]] += 1
    return starts, order
