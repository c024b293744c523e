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
from scanloom.stages.objects.association import in_line
from scanloom.stages.objects.filter import LENGTH, WIDTH, YAW, X, Y
from scanloom.stages.objects.virtual_scan import VirtualScan, said_of

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

SAMPLES = 40
OUTSIDE_M = 0.3
"""A point this far out of the other box is asked."""
GROWTH_M = 0.1


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
    for n in range(len(points)):
        if _outside(points[n, 0], points[n, 1], box[0], box[1], box[2], box[3], box[4]) < OUTSIDE_M:
            continue
        said = said_of(
            points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2], starts, returns
        )
        through += said > 0
        taken += said < 0
    return through, taken


@kernel
def without_background(
    owner: I4, band: F4, origin: F8, state: F8, row_then: I4, boxes_then: F8, origin_then: F8, starts: I4, returns: F4,
    longest: float,
) -> None:  # fmt: skip
    """Take from the tracks, in place, the points by which they would grow into what stood there before.

    Those are outside the box of their track, now and in an earlier scan, and something was there then. `row_then` (m,) is
    the row of each track in that scan, -1 where it was not seen.
    """
    for n in range(len(owner)):
        m = owner[n]
        if m < 0 or row_then[m] < 0:
            continue
        x, y, z = band[n, 0] + origin[0], band[n, 1] + origin[1], band[n, 2] + origin[2]
        if (
            _outside(x, y, state[m, X], state[m, Y], state[m, YAW], state[m, LENGTH], state[m, WIDTH])
            < GROWTH_M
        ):
            continue
        if in_line(band[n], state[m], origin, longest):
            continue
        box = boxes_then[row_then[m]]
        if _outside(x, y, box[0], box[1], box[2], box[3], box[4]) < GROWTH_M:
            continue
        if said_of(x - origin_then[0], y - origin_then[1], z - origin_then[2], starts, returns) < 0:
            owner[n] = -1


@kernel
def _outside(x: float, y: float, cx: float, cy: float, yaw: float, length: float, width: float) -> float:
    """How far a place is outside a box, m; negative inside."""
    c, s = np.cos(yaw), np.sin(yaw)
    u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
    return float(max(abs(u) - 0.5 * length, abs(v) - 0.5 * width))


@kernel
def arrived(band: F4, asked: NDArray[np.bool_], origin: F8, origin_then: F8, starts: I4, returns: F4) -> NDArray[np.bool_]:  # fmt: skip
    """Which of the asked points (n,) are at places that an earlier scan saw through."""
    out = np.zeros(len(band), np.bool_)
    for n in range(len(band)):
        if asked[n]:
            x, y, z = band[n, 0] + origin[0], band[n, 1] + origin[1], band[n, 2] + origin[2]
            out[n] = said_of(x - origin_then[0], y - origin_then[1], z - origin_then[2], starts, returns) > 0
    return out
