"""Upright columns of space around the sensor: what lies under something that stands on the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]

EDGE_M = 0.25
REACH_M = 56.0
SIDE = int(2 * REACH_M / EDGE_M)
TALL_M = 2.0
"""What hangs higher than this, a branch or a ceiling, does not stand on the ground under it."""


@kernel
def standing(forward: F4, left: F4, above: F4, low: float) -> B1:
    """Which points (n,) have others from `low` to TALL_M above the ground over them; none beyond REACH_M.

    forward, left : (n,) level coordinates, m.
    above : (n,) above the ground, m; NaN where unknown.

    A point counts for the four columns nearest to it, so within half to one and a half edges.
    """
    taken = np.zeros((SIDE, SIDE), np.bool_)
    for i in range(len(above)):
        if (
            low <= above[i] < TALL_M
            and abs(forward[i]) < REACH_M - EDGE_M
            and abs(left[i]) < REACH_M - EDGE_M
        ):
            a, b = (forward[i] + REACH_M) / EDGE_M - 0.5, (left[i] + REACH_M) / EDGE_M - 0.5
            taken[int(a), int(b)] = taken[int(a) + 1, int(b)] = True
            taken[int(a), int(b) + 1] = taken[int(a) + 1, int(b) + 1] = True
    out = np.zeros(len(above), np.bool_)
    for i in range(len(above)):
        if above[i] < low and abs(forward[i]) < REACH_M and abs(left[i]) < REACH_M:
            out[i] = taken[int((forward[i] + REACH_M) / EDGE_M), int((left[i] + REACH_M) / EDGE_M)]
    return out
