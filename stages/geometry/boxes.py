"""Which points lie in which box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]
B1 = NDArray[np.bool_]

ZERO = np.float32(0.0)
BLOCK = 2048
"""Points that are compared with all boxes while they are at hand."""
ROUNDING, ROUNDING_M = 1.001, 0.01
"""What a sphere around a box is wider than the box needs, over its radius and besides: single precision is enough for it."""


@kernel
def inside_boxes(x: F4, y: F4, z: F4, boxes: F8, inflate_m: float) -> I4:
    """Number (n,) of the first box that each point lies in, -1 for none.

    Parameters
    ----------
    x, y, z : (n,) coordinates, m; points that are not finite lie in no box.
    boxes : (m, 15) per box the upper three rows (12 numbers) of its pose, then length, width, height, m. Its origin is
        the middle of its foot, x along its length.
    inflate_m : boxes grow by this to the sides and upwards, not downwards: below is the ground.
    """
    out = np.full(len(x), -1, np.int32)
    near = near_boxes(x, y, z, boxes, inflate_m)
    for n in range(len(x)):
        if near[n]:
            out[n] = box_at(float(x[n]), float(y[n]), float(z[n]), boxes, inflate_m)
    return out


@kernel
def near_boxes(x: F4, y: F4, z: F4, boxes: F8, inflate_m: float) -> B1:
    """Which points (n,) lie in a sphere around one of the boxes: all that `inside_boxes` has in one, and more."""
    out = np.zeros(len(x), np.bool_)
    square = np.empty(len(boxes), np.float32)
    for b in range(len(boxes)):
        square[b] = (ROUNDING * np.sqrt(_reach2(boxes[b], inflate_m)) + ROUNDING_M) ** 2
    for start in range(0, len(x), BLOCK):
        end = min(start + BLOCK, len(x))
        px, py, pz = x[start:end], y[start:end], z[start:end]
        outside = np.full(end - start, np.inf, np.float32)  # m2 beyond the nearest sphere
        for b in range(len(boxes)):
            a, c, d = np.float32(boxes[b, 3]), np.float32(boxes[b, 7]), np.float32(boxes[b, 11])
            most = square[b]
            for n in range(len(outside)):  # no branch, so that the compiler takes several points at once
                u, v, w = px[n] - a, py[n] - c, pz[n] - d
                beyond = u * u + v * v + w * w - most
                outside[n] = beyond if beyond < outside[n] else outside[n]
        for n in range(len(outside)):
            out[start + n] = outside[n] <= ZERO
    return out


@kernel
def box_at(x: float, y: float, z: float, boxes: F8, inflate_m: float) -> int:
    """Number of the first box that a point lies in, -1 for none."""
    for b in range(len(boxes)):
        dx, dy, dz = x - boxes[b, 3], y - boxes[b, 7], z - boxes[b, 11]
        if not (dx * dx + dy * dy + dz * dz <= _reach2(boxes[b], inflate_m)):
            continue
        u = boxes[b, 0] * dx + boxes[b, 4] * dy + boxes[b, 8] * dz
        v = boxes[b, 1] * dx + boxes[b, 5] * dy + boxes[b, 9] * dz
        w = boxes[b, 2] * dx + boxes[b, 6] * dy + boxes[b, 10] * dz
        level = abs(u) <= 0.5 * boxes[b, 12] + inflate_m and abs(v) <= 0.5 * boxes[b, 13] + inflate_m
        if level and 0.0 <= w <= boxes[b, 14] + inflate_m:
            return b
    return -1


@kernel
def _reach2(box: F8, inflate_m: float) -> float:
    """Square of the distance, m2, from the foot of a box to its farthest corner."""
    a, b, c = 0.5 * box[12] + inflate_m, 0.5 * box[13] + inflate_m, box[14] + inflate_m
    return float(a * a + b * b + c * c)
