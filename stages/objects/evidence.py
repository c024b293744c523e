"""What free space says of a track: the places it left are seen to be empty, the places it came to were.

Two scans are held against each other. Points of the track in the one that lie outside its box in the other are asked
there: does a ray pass through, or is something there? A parked car of which more and more is seen, a wall through a
gap, a hedge: what was seen of them earlier is still there or hidden, never empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects.virtual_scan import VirtualScan, said_of

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

SAMPLES = 40
OUTSIDE_M = 0.3
"""A point this far out of the other box is asked."""


@dataclass(frozen=True)
class Reference:
    """A scan kept for later, with the points and boxes that its tracks had."""

    stamp_ns: int
    scan: VirtualScan
    number: dict[int, int]
    """Row by track."""
    boxes: F8
    """(m, 5) x, y, yaw, length, width."""
    starts: I4
    points: F8
    """(k, 3) in level axes of the odometry, those of row m from starts[m] on."""


@kernel
def sampled(band: F4, starts: I4, order: I4, origin: F8) -> tuple[I4, F8]:
    """At most SAMPLES points of each group, in level axes of the odometry."""
    m = len(starts) - 1
    out = np.empty((m * SAMPLES, 3))
    first = np.zeros(m + 1, np.int32)
    k = 0
    for g in range(m):
        size = starts[g + 1] - starts[g]
        take = min(size, SAMPLES)
        for i in range(take):
            n = order[starts[g] + i * size // take]
            for axis in range(3):
                out[k, axis] = band[n, axis] + origin[axis]
            k += 1
        first[g + 1] = k
    return first, out[:k].copy()


@kernel
def asked(points: F8, box: F8, origin: F8, starts: I4, returns: F4) -> tuple[int, int]:
    """How many of a track's points (k, 3) that lie outside a box a scan saw through, and where it saw something."""
    through, taken = 0, 0
    c, s = np.cos(box[2]), np.sin(box[2])
    for n in range(len(points)):
        dx, dy = points[n, 0] - box[0], points[n, 1] - box[1]
        u, v = abs(c * dx + s * dy) - 0.5 * box[3], abs(c * dy - s * dx) - 0.5 * box[4]
        if max(u, v) < OUTSIDE_M:
            continue
        said = said_of(
            points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2], starts, returns
        )
        through += said > 0
        taken += said < 0
    return through, taken
