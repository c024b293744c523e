"""The virtual scan: what stands between ankle and roof around the vehicle, and how far it is seen along each bearing.

Points are turned into level axes around the LiDAR and sorted by bearing. Those 0.3 to 2.2 m above the ground are the band
that is clustered and tracked; all others tell of free space.
Source: methods 1.5.1, steps 1 and 3 (Ren et al. 2021; Petrovskaya and Thrun 2009).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]

BINS = 2048
CELL_M = 2.0
CELLS = 64
"""Cells of ground to a side, around the LiDAR."""
SPREADS = 8
"""Cells that ground is continued by, where none is seen."""
LONE_GROUND = 3
GROUND, UNLABELLED = int(PointClass.GROUND), int(PointClass.UNLABELLED)
STATIC, DYNAMIC = int(PointClass.STATIC), int(PointClass.DYNAMIC)


@dataclass(frozen=True)
class VirtualScan:
    """A scan in level axes, sorted by bearing; metres from the LiDAR."""

    starts: I4
    """(BINS + 1,) first return of each bearing."""
    returns: F4
    """(n, 3) distance over ground, rise, and bearing rad, of every return."""
    band: F4
    """(k, 4) x, y, z and height above the ground of what may be part of an object."""
    ground: F4
    """(CELLS, CELLS) height of the ground, m."""
    origin: F8
    """(3,) where the LiDAR is in the level axes of the odometry, m."""


def virtual_scan(
    x: F4, y: F4, z: F4, classes: U1, T_level_lidar: F8, ground_z_m: float, limits: tuple[float, float, float]
) -> VirtualScan:
    """Points (n,) of a scan with their classes; the ground's height under the LiDAR where none is seen; and the lowest
    and highest height above ground and the farthest range, m, of what is tracked."""
    low, high, far = limits
    R = np.ascontiguousarray(T_level_lidar[:3, :3])
    level, bearing, kind = _level(x, y, z, classes, R, far)
    ground = _ground(level, kind, ground_z_m)
    starts, returns, band = _sorted(level, bearing, kind, ground, low, high)
    return VirtualScan(starts, returns, band, ground, T_level_lidar[:3, 3].copy())


@kernel
def _level(x: F4, y: F4, z: F4, classes: U1, R: F8, far: float) -> tuple[F4, F4, U1]:
    """Level coordinates, bearings and kind (0 ground, 1 thing; 2 thing out of reach) of all returns of scenery."""
    level = np.empty((len(x), 3), np.float32)
    bearing = np.empty(len(x), np.float32)
    kind = np.empty(len(x), np.uint8)
    n = 0
    for i in range(len(x)):
        c = classes[i]
        if c != GROUND and c != STATIC and c != DYNAMIC and c != UNLABELLED:
            continue
        px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
        u = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        v = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        w = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        if not (np.isfinite(u) and np.isfinite(v) and np.isfinite(w)):
            continue
        level[n, 0], level[n, 1], level[n, 2] = u, v, w
        bearing[n] = np.arctan2(v, u)
        kind[n] = 0 if c == GROUND else (1 if u * u + v * v < far * far else 2)
        n += 1
    return level[:n], bearing[:n], kind[:n]


@kernel
def _ground(level: F4, kind: U1, fallback: float) -> F4:
    """Mean height of the ground's returns per cell, continued by the neighbours' where there are none."""
    total = np.zeros((CELLS, CELLS))
    count = np.zeros((CELLS, CELLS), np.int32)
    for i in range(len(level)):
        if kind[i] == 0:
            a = int(np.floor(level[i, 0] / CELL_M)) + CELLS // 2
            b = int(np.floor(level[i, 1] / CELL_M)) + CELLS // 2
            if 0 <= a < CELLS and 0 <= b < CELLS:
                total[a, b] += level[i, 2]
                count[a, b] += 1
    ground = np.full((CELLS, CELLS), np.nan, np.float32)
    for a in range(CELLS):
        for b in range(CELLS):
            if count[a, b] >= LONE_GROUND:
                ground[a, b] = total[a, b] / count[a, b]
    for _ in range(SPREADS):
        ground = _spread(ground)
    for a in range(CELLS):
        for b in range(CELLS):
            if not np.isfinite(ground[a, b]):
                ground[a, b] = fallback
    return ground


@kernel
def _spread(ground: F4) -> F4:
    out = ground.copy()
    for a in range(CELLS):
        for b in range(CELLS):
            if np.isfinite(ground[a, b]):
                continue
            total, count = 0.0, 0
            for i in range(max(a - 1, 0), min(a + 2, CELLS)):
                for j in range(max(b - 1, 0), min(b + 2, CELLS)):
                    if np.isfinite(ground[i, j]):
                        total += ground[i, j]
                        count += 1
            if count > 0:
                out[a, b] = total / count
    return out


@kernel
def ground_at(ground: F4, x: float, y: float) -> float:
    """Height of the ground at a place, m from the LiDAR; that of the edge beyond it."""
    a = min(max(int(np.floor(x / CELL_M)) + CELLS // 2, 0), CELLS - 1)
    b = min(max(int(np.floor(y / CELL_M)) + CELLS // 2, 0), CELLS - 1)
    return float(ground[a, b])


@kernel
def bin_of(bearing: float) -> int:
    """Bin of a bearing, rad."""
    return int(np.floor((bearing + np.pi) * (BINS / (2.0 * np.pi)))) % BINS


@kernel
def _sorted(level: F4, bearing: F4, kind: U1, ground: F4, low: float, high: float) -> tuple[I4, F4, F4]:
    starts = np.zeros(BINS + 1, np.int32)
    for i in range(len(level)):
        starts[bin_of(bearing[i]) + 1] += 1
    for b in range(BINS):
        starts[b + 1] += starts[b]
    following = starts[:-1].copy()
    returns = np.empty((len(level), 3), np.float32)
    band = np.empty((len(level), 4), np.float32)
    k = 0
    for i in range(len(level)):
        b = bin_of(bearing[i])
        at = following[b]
        following[b] += 1
        returns[at, 0] = np.hypot(level[i, 0], level[i, 1])
        returns[at, 1] = level[i, 2]
        returns[at, 2] = bearing[i]
        if kind[i] != 1:
            continue
        above = level[i, 2] - ground_at(ground, level[i, 0], level[i, 1])
        if low <= above <= high:
            band[k, 0], band[k, 1], band[k, 2], band[k, 3] = level[i, 0], level[i, 1], level[i, 2], above
            k += 1
    return starts, returns, band[:k]


SAME_M, BEYOND_M = 0.4, 0.6
"""A return this near to a place says that it is taken; one this far behind it that it is empty."""
SIDE_M, SIDE_SHARE = 0.25, 0.006
"""How far beside a place something may be that says so, and so much more per metre of range."""
PASSING_M, PASSING_SHARE = 0.1, 0.003
"""How far a ray may pass beside a place that it says is empty: not over the roof or past the corner of a car."""


@kernel
def said_of(px: float, py: float, pz: float, starts: I4, returns: F4) -> int:
    """1 seen through, -1 something is there, 0 nothing can be told, of a place in level axes from the LiDAR."""
    r = np.hypot(px, py)
    if r < 1.0:
        return 0
    bearing = np.arctan2(py, px)
    side = SIDE_M + SIDE_SHARE * r
    beside = PASSING_M + PASSING_SHARE * r
    around = min(int(side / r * (BINS / (2.0 * np.pi))) + 1, 12)
    middle = bin_of(bearing)
    passed, hidden = False, False
    for step in range(2 * around + 1):  # 0, 1, -1, 2, ...: what is there is mostly found at once
        b = middle + (step + 1) // 2 * (1 if step % 2 else -1)
        for k in range(starts[b % BINS], starts[b % BINS + 1]):
            far = np.float64(returns[k, 0])
            behind = far - r
            if (behind <= -SAME_M and hidden) or (behind >= SAME_M and (passed or far <= r + BEYOND_M)):
                continue  # tells nothing that is not known
            rise = returns[k, 1] * (r / far) - pz
            if abs(rise) > side:
                continue
            turn = abs(returns[k, 2] - bearing)
            turn = min(turn, 2.0 * np.pi - turn) * r
            if turn > side:
                continue
            if abs(behind) < SAME_M:
                return -1
            if far < r:
                hidden = True
            elif abs(rise) < beside and turn < beside:
                passed = True
    return 1 if passed and not hidden else 0
