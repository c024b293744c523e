"""Joining windows: where the next window's frame lies in the one before, from the scans that both have.

Both windows tracked the scans of the overlap. Each such scan says where the two frames lie to each other; the mean of
what they say, weighted by the covariances, is the start of a registration of the later window's scans to the earlier
window's local map. Directions the registration does not see stay as the mean says.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from scanloom.schemas.product import columns_of
from scanloom.schemas.trajectory import Odometry
from scanloom.schemas.windows import Track, TrackEnds
from scanloom.stages.geometry.degeneracy import judge
from scanloom.stages.geometry.registration import VoxelMap, align
from scanloom.stages.geometry.se3 import F8, adjoint, inverse, se3_exp, se3_log
from scanloom.stages.odometry.aside import untold
from scanloom.stages.odometry.settings import Settings

ALIKE_SCANS = 10.0
"""Neighbouring scans are off by nearly the same: so many count as one."""
SCALE_M = 0.15
LEAST_INLIERS = 100
FARTHEST_M, FARTHEST_RAD = 0.5, 0.03


@dataclass(frozen=True)
class Seam:
    """Pose (4, 4) of the last common scan as the later window has it, in that scan as the earlier one has it; covariance."""

    T: F8
    covariance: F8


def join(settings: Settings, tracks: Sequence[Track], ends: Sequence[TrackEnds]) -> Odometry:
    """Rows of the whole session, in the frame of the first window. Each window gives the scans that are its own."""
    windows = zip(tracks, ends, strict=True)
    first, _ = before = next(windows)
    joined = [_rows(first, slice(None))]
    for after in windows:
        seam = seam_of(settings, *before, *after)
        joined[-1] = joined[-1] if seam else _changed_at(joined[-1], -1, keyframe=True)
        joined.append(_continued(joined[-1], after[0], seam))
        before = after
    return Odometry.concatenate(joined)


def _continued(joined: Odometry, after: Track, seam: Seam | None) -> Odometry:
    """The later window's own rows, placed behind the rows so far."""
    end, own = after.overlap - 1, _rows(after, slice(after.overlap, None))
    T_end = joined.T_odom_lidar[-1] @ (seam.T if seam else np.eye(4))
    T_first_after = T_end @ inverse(after.T_odom_lidar[end])
    lift = int(joined.segment[-1]) - int(after.segment[end]) + (seam is None)
    moved = dataclasses.replace(
        own, T_odom_lidar=T_first_after @ own.T_odom_lidar, segment=own.segment + np.int32(lift)
    )
    if seam is None:
        pause_s = 1e-9 * float(own.stamp_ns[0] - joined.stamp_ns[-1])
        return _changed_at(moved, 0, covariance=untold(pause_s), keyframe=True, reliable=False)
    A = adjoint(inverse(own.T_odom_lidar[0]) @ after.T_odom_lidar[end])
    return _changed_at(moved, 0, covariance=A @ seam.covariance @ A.T + own.covariance[0])


def _rows(track: Track, rows: slice) -> Odometry:
    return Odometry(**{name: getattr(track, name)[rows] for name in columns_of(Odometry)})


def _changed_at(rows: Odometry, place: int, **values: Any) -> Odometry:
    """The same with other values in one row."""
    columns = {name: getattr(rows, name).copy() for name in values}
    for name, value in values.items():
        columns[name][place] = value
    return dataclasses.replace(rows, **columns)


def seam_of(
    settings: Settings, before: Track, before_ends: TrackEnds, after: Track, after_ends: TrackEnds
) -> Seam | None:
    """How the two windows lie to each other at their last common scan; None when no scan was registered in both."""
    mean = _mean(before, after)
    if mean is None:
        return None
    target = VoxelMap(before_ends.voxel_size_m, settings.points_per_voxel)
    target.insert(before_ends.points(at_end=True))
    points = after_ends.points(at_end=False)
    lay = partial(
        align, target, points, mean.T, max_distance_m=target.voxel_size_m, scale_m=SCALE_M,
        max_iterations=settings.max_iterations,
    )  # fmt: skip
    found = lay()
    seen = judge(found, point_noise_m=settings.point_noise_m, snr=settings.snr)
    if (seen.p < settings.least_p).any():
        found = lay(free=seen.observed(settings.least_p))
    off = se3_log(inverse(mean.T) @ found.T_target_source)
    far = np.linalg.norm(off[3:]) > FARTHEST_M or np.linalg.norm(off[:3]) > FARTHEST_RAD
    if far or found.inlier_ratio * len(points) < LEAST_INLIERS:
        return mean
    information = seen.scan_information(settings.least_p, settings.covariance_inflation)
    covariance = np.linalg.inv(information + np.linalg.inv(mean.covariance))
    return Seam(found.T_target_source, 0.5 * (covariance + covariance.T) + settings.floor)


def _mean(before: Track, after: Track) -> Seam | None:
    """Weighted mean of what each common scan says, carried to the last one.

    A scan's word is as good as its own two registrations and the motions from it to the last scan in both windows.
    """
    common = after.overlap
    ours, theirs = _rows(before, slice(len(before) - common, None)), _rows(after, slice(common))
    T_end_ours = inverse(ours.T_odom_lidar[-1]) @ ours.T_odom_lidar
    T_end_theirs = inverse(theirs.T_odom_lidar[-1]) @ theirs.T_odom_lidar
    carried, information, total = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    count = 0
    for k in reversed(range(common)):
        if ours.segment[k] != ours.segment[-1] or theirs.segment[k] != theirs.segment[-1]:
            break
        A = adjoint(T_end_ours[k])
        noise = A @ (ours.covariance[k] + theirs.covariance[k]) @ A.T
        if ours.reliable[k] and theirs.reliable[k]:
            said = se3_log(T_end_ours[k] @ inverse(T_end_theirs[k]))
            weight = np.linalg.inv(carried + noise)
            information, total, count = information + weight, total + weight @ said, count + 1
        carried = carried + noise
    if not count:
        return None
    covariance = min(float(count), ALIKE_SCANS) * np.linalg.inv(information)
    return Seam(se3_exp(np.linalg.solve(information, total)), 0.5 * (covariance + covariance.T))
