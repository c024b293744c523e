"""Joining windows: where the next window's frame lies in the one before, from the scans that both have.

Both windows tracked the scans of the overlap. Each such scan says where the two frames lie to each other; the mean of
what they say, weighted by the covariances, is the start of a registration of the later window's scans to the earlier
window's local map. Directions the registration does not see stay as the mean says.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from scanloom.stages.geometry.degeneracy import judge
from scanloom.stages.geometry.registration import VoxelMap, align
from scanloom.stages.geometry.se3 import F8, adjoint, inverse, se3_exp, se3_log, transform
from scanloom.stages.odometry.aside import untold
from scanloom.stages.odometry.rows import Row
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.windows import Window

ALIKE_SCANS = 10.0
"""Neighbouring scans are off by nearly the same: so many count as one."""
SCALE_M = 0.15
LEAST_INLIERS = 100
FARTHEST_M, FARTHEST_RAD = 0.5, 0.03


@dataclass(frozen=True)
class Tracked:
    """What tracking a window gave: its rows, its local map at the end, and thinned scans (row, points (n, 3)) of the overlap
    with the window before."""

    window: Window
    rows: Sequence[Row]
    map: VoxelMap
    kept: Sequence[tuple[int, F8]]


@dataclass(frozen=True)
class Seam:
    """Pose (4, 4) of the last common scan as the later window has it, in that scan as the earlier one has it; covariance."""

    T: F8
    covariance: F8


def join(settings: Settings, parts: Sequence[Tracked]) -> list[Row]:
    """Rows of the whole session, in the frame of the first window. Each window gives the scans from its `own` on."""
    joined = list(parts[0].rows)
    for before, after in itertools.pairwise(parts):
        joined += _continued(settings, joined, before, after)
    return joined


def _continued(settings: Settings, joined: list[Row], before: Tracked, after: Tracked) -> list[Row]:
    """The later window's own rows, placed behind the rows so far."""
    last = joined[-1]
    at = after.window.own - after.window.first
    end, first = after.rows[at - 1], after.rows[at]
    seam = seam_of(settings, before, after)
    T_end = last.T_odom_lidar @ (seam.T if seam else np.eye(4))
    T_first_after = T_end @ inverse(end.T_odom_lidar)
    covariance = untold(1e-9 * (first.stamp_ns - last.stamp_ns))
    if seam is not None:
        A = adjoint(inverse(first.T_odom_lidar) @ end.T_odom_lidar)
        covariance = A @ seam.covariance @ A.T + first.covariance
    if seam is None:
        joined[-1] = dataclasses.replace(last, keyframe=True)
    lift = last.segment - end.segment + (seam is None)
    moved = [
        dataclasses.replace(r, T_odom_lidar=T_first_after @ r.T_odom_lidar, segment=r.segment + lift)
        for r in after.rows[at:]
    ]
    moved[0] = dataclasses.replace(
        moved[0], covariance=covariance, keyframe=moved[0].keyframe or seam is None,
        reliable=moved[0].reliable and seam is not None,
    )  # fmt: skip
    return moved


def seam_of(settings: Settings, before: Tracked, after: Tracked) -> Seam | None:
    """How the two windows lie to each other at their last common scan; None when no scan was registered in both."""
    start = after.window.first - before.window.first
    common = len(before.rows) - start
    ours, theirs = before.rows[start:], after.rows[:common]
    mean = _mean(ours, theirs)
    if mean is None:
        return None
    points = _cloud(after, theirs[-1])
    T_before_end = ours[-1].T_odom_lidar
    lay = partial(
        align, before.map, points, T_before_end @ mean.T, max_distance_m=before.map.voxel_size_m, scale_m=SCALE_M,
        max_iterations=settings.max_iterations,
    )  # fmt: skip
    found = lay()
    seen = judge(found, point_noise_m=settings.point_noise_m, snr=settings.snr)
    if (seen.p < settings.least_p).any():
        found = lay(free=seen.observed(settings.least_p))
    T = inverse(T_before_end) @ found.T_target_source
    off = se3_log(inverse(mean.T) @ T)
    far = np.linalg.norm(off[3:]) > FARTHEST_M or np.linalg.norm(off[:3]) > FARTHEST_RAD
    if far or found.inlier_ratio * len(points) < LEAST_INLIERS:
        return mean
    information = seen.scan_information(settings.least_p, settings.covariance_inflation)
    covariance = np.linalg.inv(information + np.linalg.inv(mean.covariance))
    return Seam(T, 0.5 * (covariance + covariance.T) + settings.floor)


def _mean(ours: Sequence[Row], theirs: Sequence[Row]) -> Seam | None:
    """Weighted mean of what each common scan says, carried to the last one.

    A scan's word is as good as its own two registrations and the motions from it to the last scan in both windows.
    """
    end, other_end = ours[-1], theirs[-1]
    carried, information, total = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    count = 0
    for a, b in zip(reversed(ours), reversed(theirs), strict=True):
        if a.segment != end.segment or b.segment != other_end.segment:
            break
        T_end_a = inverse(end.T_odom_lidar) @ a.T_odom_lidar
        A = adjoint(T_end_a)
        noise = A @ (a.covariance + b.covariance) @ A.T
        if a.reliable and b.reliable:
            said = se3_log(T_end_a @ inverse(inverse(other_end.T_odom_lidar) @ b.T_odom_lidar))
            weight = np.linalg.inv(carried + noise)
            information, total, count = information + weight, total + weight @ said, count + 1
        carried = carried + noise
    if not count:
        return None
    covariance = min(float(count), ALIKE_SCANS) * np.linalg.inv(information)
    return Seam(se3_exp(np.linalg.solve(information, total)), 0.5 * (covariance + covariance.T))


def _cloud(after: Tracked, end: Row) -> F8:
    """Scans of the overlap in the frame of its last scan, by the later window's poses."""
    clouds = [
        transform(inverse(end.T_odom_lidar) @ after.rows[row].T_odom_lidar, points)
        for row, points in after.kept
    ]
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))
