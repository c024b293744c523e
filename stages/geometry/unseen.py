"""Directions of motion that registration did not see, scan by scan (methods 1.7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import F8

SEEN_P = 0.5
"""Directions observed beyond noise with a smaller probability were not seen."""
KINDS = ("along", "across", "up", "turn")
"""Of a direction, seen from the vehicle: along x, y, z of the base, or a rotation."""


def unseen(odometry: Odometry) -> NDArray[np.bool_]:
    """Scans (n,) whose registration did not see some direction."""
    return np.asarray(_weak(odometry).any(axis=1))


def unseen_kinds(odometry: Odometry, R_base_lidar: F8) -> NDArray[np.bool_]:
    """Which `KINDS` (n, 4) each scan did not see; a direction between two counts for the nearer one."""
    weak = _weak(odometry)
    rotation = np.linalg.norm(odometry.weak_directions[:, :3], axis=1)
    shift = np.abs(R_base_lidar @ odometry.weak_directions[:, 3:])
    kind = np.where(rotation > np.linalg.norm(shift, axis=1), 3, shift.argmax(axis=1))
    return np.stack([(weak & (kind == k)).any(axis=1) for k in range(len(KINDS))], axis=1)


def _weak(odometry: Odometry) -> NDArray[np.bool_]:
    """Directions (n, 6) that were not seen; the first scan of a segment has no motion to be seen."""
    weak = np.asarray(odometry.direction_p < SEEN_P)
    first = np.diff(odometry.segment, prepend=-1) != 0
    return np.asarray(weak & ~first[:, None])


def stretches(marked: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last row of every run of marked scans, begun by the scan before it: a motion leads to a scan."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], marked, [False])).astype(np.int8)))
    return [(max(int(a) - 1, 0), int(b) - 1) for a, b in zip(edges[::2], edges[1::2])]
