"""Loop closures against truth: which are true, and how many of the revisits were found."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.loops import Loops
from scanloom.schemas.trajectory import Odometry, Truth
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8, inverse

REVISIT_DISTANCE_M = 4.0
REVISIT_PATH_M = 50.0
FOUND_WITHIN_M = 10.0


@dataclass(frozen=True)
class TruePath:
    """True poses (n, 4, 4) of the scans of one session that truth covers, and their numbers (n,)."""

    scan_index: NDArray[np.int64]
    T: F8

    def at(self, scans: NDArray[np.int64]) -> tuple[F8, NDArray[np.bool_]]:
        """Poses of scans (m,), and which of them truth covers."""
        if len(self.scan_index) == 0:
            return np.tile(np.eye(4), (len(scans), 1, 1)), np.zeros(len(scans), bool)
        row = np.clip(np.searchsorted(self.scan_index, scans), 0, len(self.scan_index) - 1)
        return self.T[row], self.scan_index[row] == scans


def true_path(truth: Truth, odometry: Odometry) -> TruePath:
    """True poses of the scans that odometry has and truth covers."""
    covered = inside(truth.stamp_ns, odometry.stamp_ns)
    if not covered.any():
        return TruePath(np.empty(0, np.int64), np.empty((0, 4, 4)))
    T = interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, odometry.stamp_ns[covered])
    return TruePath(odometry.scan_index[covered], T)


def loop_figures(
    loops: Loops, paths: dict[str, TruePath], max_error_m: float, max_error_deg: float
) -> Iterator[Figure]:
    """Counts of loops, and precision and recall where truth covers them.

    Only loops within one session are judged, because truths of two sessions need not share a frame.
    """
    yield Figure("loops.candidates", len(loops), "", "pairs of places compared", "map")
    yield Figure("loops.accepted", int(loops.accepted.sum()), "", "pairs that entered the pose graph", "map")
    judged, true = judge(loops, paths, max_error_m, max_error_deg)
    if judged.any():
        how = (
            f"share of {int(judged.sum())} accepted loops within one session whose relative pose is within "
            f"{max_error_m:g} m and {max_error_deg:g} deg of truth"
        )
        yield Figure("loops.precision", float(true[judged].mean()), "", how, "map")
    found, revisits = recall(loops, true, paths)
    if revisits:
        how = (
            f"share of {revisits} scans back within {REVISIT_DISTANCE_M:g} m of a place left "
            f"{REVISIT_PATH_M:g} m of path before, with a true loop within {FOUND_WITHIN_M:g} m of path"
        )
        yield Figure("loops.recall", found / revisits, "", how, "map")


def judge(
    loops: Loops, paths: dict[str, TruePath], max_error_m: float, max_error_deg: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which loops (n,) are accepted and can be judged, and which of these are true."""
    judged, true = np.zeros(len(loops), bool), np.zeros(len(loops), bool)
    for session, path in paths.items():
        rows = np.flatnonzero(loops.accepted & (loops.session_i == session) & (loops.session_j == session))
        T_i, known_i = path.at(loops.scan_i[rows])
        T_j, known_j = path.at(loops.scan_j[rows])
        metres, radians = alignment.motion_error(inverse(T_i) @ T_j, loops.T_i_j[rows])
        judged[rows] = known_i & known_j
        true[rows] = judged[rows] & (metres < max_error_m) & (np.degrees(radians) < max_error_deg)
    return judged, true


def recall(loops: Loops, true: NDArray[np.bool_], paths: dict[str, TruePath]) -> tuple[int, int]:
    """How many scans that come back to a place have a true loop near, and how many come back at all."""
    found = revisits = 0
    for session, path in paths.items():
        if len(path.T) < 2:
            continue
        travelled = alignment.travelled(path.T)
        back = travelled[_comes_back(path.T[:, :3, 3], travelled)]
        rows = true & (loops.session_i == session) & (loops.session_j == session)
        closed = travelled[np.searchsorted(path.scan_index, loops.scan_j[rows])]
        revisits += len(back)
        if len(closed):
            found += int((np.abs(back[:, None] - closed).min(axis=1) <= FOUND_WITHIN_M).sum())
    return found, revisits


def _comes_back(positions: F8, travelled: F8) -> NDArray[np.bool_]:
    """Which positions (n, 3) lie near one that was left long before along the path."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(positions).query_pairs(REVISIT_DISTANCE_M, output_type="ndarray")
    later = pairs[travelled[pairs[:, 1]] - travelled[pairs[:, 0]] > REVISIT_PATH_M][:, 1]
    back = np.zeros(len(positions), bool)
    back[later] = True
    return back
