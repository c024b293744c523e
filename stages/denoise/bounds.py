"""Which points are the own vehicle or out of range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]
OUT_OF_RANGE, EGO, STATIC = int(PointClass.OUT_OF_RANGE), int(PointClass.EGO), int(PointClass.STATIC)


@kernel
def bounded(x: F4, y: F4, z: F4, T: F8, low: F8, high: F8, nearest: float, farthest: float) -> U1:
    """OUT_OF_RANGE, EGO, or STATIC for the rest (n,): T_base_lidar and a box (3,), (3,) in the base frame, ranges, m."""
    out = np.empty(len(x), np.uint8)
    top = min(high[2], T[2, 3])
    reach2 = _reach2(T, low, high)
    for i in range(len(x)):
        px, py, pz = float(x[i]), float(y[i]), float(z[i])
        square = px * px + py * py + pz * pz
        if not (0.0 < square <= farthest * farthest):  # also catches NaN
            out[i] = OUT_OF_RANGE
            continue
        if square > reach2 and square >= nearest * nearest:
            out[i] = STATIC
            continue
        u = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        v = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        w = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if low[0] < u < high[0] and low[1] < v < high[1] and low[2] < w < top:
            out[i] = EGO
        elif square < nearest * nearest:
            out[i] = OUT_OF_RANGE
        else:
            out[i] = STATIC
    return out


@kernel
def _reach2(T: F8, low: F8, high: F8) -> float:
    """Square of a distance from the LiDAR, m2, that the own vehicle does not reach."""
    square = 0.0
    for k in range(3):
        square += max(abs(low[k] - T[k, 3]), abs(high[k] - T[k, 3])) ** 2
    return 1.001 * square
