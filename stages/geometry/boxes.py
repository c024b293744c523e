"""Which points lie in which box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]


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
    reach = np.empty(len(boxes))
    for b in range(len(boxes)):
        half = np.hypot(0.5 * boxes[b, 12] + inflate_m, 0.5 * boxes[b, 13] + inflate_m)
        reach[b] = half * half + (boxes[b, 14] + inflate_m) ** 2
    for n in range(len(x)):
        for b in range(len(boxes)):
            dx, dy, dz = x[n] - boxes[b, 3], y[n] - boxes[b, 7], z[n] - boxes[b, 11]
            if not (dx * dx + dy * dy + dz * dz <= reach[b]):
                continue
            u = boxes[b, 0] * dx + boxes[b, 4] * dy + boxes[b, 8] * dz
            v = boxes[b, 1] * dx + boxes[b, 5] * dy + boxes[b, 9] * dz
            w = boxes[b, 2] * dx + boxes[b, 6] * dy + boxes[b, 10] * dz
            level = abs(u) <= 0.5 * boxes[b, 12] + inflate_m and abs(v) <= 0.5 * boxes[b, 13] + inflate_m
            if level and 0.0 <= w <= boxes[b, 14] + inflate_m:
                out[n] = b
                break
    return out
