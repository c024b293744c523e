"""How well the sessions of a map lie to each other, by truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from scanloom.schemas.trajectory import Poses
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.evaluation.paths import TruePath
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.se3 import F8, inverse

MEETING_M = 5.0
"""Scans of two sessions this near to each other in truth are held against each other."""


def session_figures(paths: Mapping[str, TruePath], poses: Mapping[str, Poses]) -> Iterator[Figure]:
    """Error of the pose of one session in another where both pass; nothing when no two of them meet in truth."""
    errors = [
        between(paths[a], poses[a], paths[b], poses[b])
        for a, b in combinations(sorted(paths.keys() & poses.keys()), 2)
        if paths[a].frame == paths[b].frame
    ]
    every = np.concatenate([np.empty((0, 2)), *errors])
    if len(every):
        how = (
            f"root mean square error of the pose of a keyframe in the nearest one of another session, at {len(every)} "
            f"places where both pass within {MEETING_M:g} m"
        )
        yield Figure("fusion.inter_session_rmse_m", alignment.rms(every[:, 0]), "m", how, "map")
        yield Figure(
            "fusion.inter_session_rmse_deg", alignment.rms(np.degrees(every[:, 1])), "deg", how, "map"
        )


def between(path_a: TruePath, poses_a: Poses, path_b: TruePath, poses_b: Poses) -> F8:
    """Errors (m, 2), m and rad, of the keyframes of b in their nearest ones of a."""
    from scipy.spatial import cKDTree

    true_a, T_a = _common(path_a, poses_a)
    true_b, T_b = _common(path_b, poses_b)
    if not len(true_a) or not len(true_b):
        return np.empty((0, 2))
    distance, nearest = cKDTree(true_a[:, :3, 3]).query(true_b[:, :3, 3], distance_upper_bound=MEETING_M)
    meets = np.isfinite(distance)
    i = nearest[meets]
    metres, radians = alignment.motion_error(inverse(true_a[i]) @ true_b[meets], inverse(T_a[i]) @ T_b[meets])
    return np.column_stack((metres, radians))


def _common(path: TruePath, poses: Poses) -> tuple[F8, F8]:
    """True and estimated poses of the keyframes that both have."""
    _, true, estimated = np.intersect1d(path.scan_index[path.keyframe], poses.scan_index, return_indices=True)
    return path.T[path.keyframe][true], poses.T_world_lidar[estimated]
