"""When a point of the map was met again: on a later pass, or by another session.

A tile knows when each of its points was first and last met. In one pass by, the way driven between the two is about as long as
the distances of the point to the vehicle at both times, or shorter; who went away and came back has driven farther. A point
is met again when the way is more than twice as long, and 20 m on top of that: curves do not count, nor does standing still.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tiles import Tile
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I8 = NDArray[np.int64]

TIMES_AS_LONG, LONGER_M = 2.0, 20.0


class Passes:
    """All sessions of the map one after the other; between two of them lies a way without end.

    Sessions whose stamps overlap cannot be told apart by a stamp: then `known` is false, and nothing counts as met again.
    """

    def __init__(self, poses: Mapping[str, Poses]) -> None:
        driven = sorted((p for p in poses.values() if len(p)), key=lambda p: int(p.stamp_ns[0]))
        self.known = all(a.stamp_ns[-1] < b.stamp_ns[0] for a, b in pairwise(driven))
        usable = driven if self.known else []
        self.stamp_ns: I8 = np.concatenate([np.empty(0, np.int64), *(p.stamp_ns for p in usable)])
        self.position_m: F8 = np.concatenate([np.empty((0, 3)), *(p.T_world_lidar[:, :3, 3] for p in usable)])
        ways = [alignment.travelled(p.T_world_lidar) for p in usable]
        self.way_m: F8 = np.concatenate([np.empty(0), *ways])
        self.session: I8 = np.repeat(np.arange(len(usable)), [len(p) for p in usable])
        self.several = len(driven) > 1

    def met_again(self, tile: Tile) -> tuple[B1, B1]:
        """Which points (n,) were met again on a later pass, another session's among them; and by another session."""
        again, other = np.zeros(len(tile), bool), np.zeros(len(tile), bool)
        if len(self.stamp_ns):
            _met_again(
                tile.x_m, tile.y_m, tile.z_m, np.array(tile.offset_m, float), tile.first_ns, tile.last_ns, self.stamp_ns,
                self.position_m, self.way_m, self.session, again, other,
            )  # fmt: skip
        return again, other


@kernel
def _met_again(
    x: F4, y: F4, z: F4, offset: F8, first_ns: I8, last_ns: I8, stamp_ns: I8, position: F8, way: F8, session: I8,
    again: B1, other: B1,
) -> None:  # fmt: skip
    last = len(stamp_ns) - 1
    for n in range(len(x)):
        if last_ns[n] <= first_ns[n]:
            continue
        i = min(np.searchsorted(stamp_ns, first_ns[n]), last)
        j = min(np.searchsorted(stamp_ns, last_ns[n]), last)
        if session[i] != session[j]:
            again[n] = other[n] = True
            continue
        near = 0.0
        for k in (i, j):
            dx = position[k, 0] - offset[0] - x[n]
            dy = position[k, 1] - offset[1] - y[n]
            dz = position[k, 2] - offset[2] - z[n]
            near += np.sqrt(dx * dx + dy * dy + dz * dz)
        again[n] = way[j] - way[i] > TIMES_AS_LONG * near + LONGER_M
