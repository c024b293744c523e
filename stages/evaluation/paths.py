"""True paths of the sessions of a map, in one frame wherever their truths tell how they lie to each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.frames import Georeference
from scanloom.schemas.trajectory import Odometry, Truth
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.geodesy import between_worlds
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]


@dataclass(frozen=True)
class TruePath:
    """True poses (n, 4, 4) of the scans of one session that truth covers, and what odometry says of the same scans."""

    scan_index: I8
    stamp_ns: I8
    T: F8
    keyframe: NDArray[np.bool_]
    frame: str
    """Paths of the same frame lie to each other as their poses say."""

    def __len__(self) -> int:
        return len(self.scan_index)

    @property
    def travelled_m(self) -> F8:
        """Path length (n,) from the first of these scans."""
        return alignment.travelled(self.T) if len(self) else np.empty(0)

    def rows(self, scans: I8) -> tuple[I8, NDArray[np.bool_]]:
        """Row of each scan (m,), and which of the scans truth covers; rows of the others mean nothing."""
        if len(self) == 0:
            return np.zeros(len(scans), np.int64), np.zeros(len(scans), bool)
        row = np.clip(np.searchsorted(self.scan_index, scans), 0, len(self) - 1)
        return row, self.scan_index[row] == scans


def true_paths(truths: Mapping[str, Truth], odometries: Mapping[str, Odometry]) -> dict[str, TruePath]:
    """True paths of all sessions that have truth, those with a georeference in the frame of the first of them."""
    origin = next((place for name in sorted(truths) if (place := georeference_of(truths[name]))), None)
    paths = {}
    for name, truth in sorted(truths.items()):
        if name not in odometries:
            continue
        place = georeference_of(truth)
        T_common_truth = between_worlds(origin, place) if origin and place else np.eye(4)
        paths[name] = _path(truth, odometries[name], T_common_truth, "world" if place else name)
    return paths


def georeference_of(truth: Truth) -> Georeference | None:
    """Where the frame of truth stands on the Earth, if it tells."""
    return None if truth.georeference is None else Georeference(**truth.georeference)


def _path(truth: Truth, odometry: Odometry, T_common_truth: F8, frame: str) -> TruePath:
    rows = np.flatnonzero(inside(truth.stamp_ns, odometry.stamp_ns))
    stamp_ns = odometry.stamp_ns[rows]
    T = (
        T_common_truth @ interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, stamp_ns)
        if len(rows)
        else np.empty((0, 4, 4))
    )
    return TruePath(odometry.scan_index[rows], stamp_ns, T, odometry.keyframe[rows], frame)
