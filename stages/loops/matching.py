"""Two stages of matching one submap with another (methods 1.11): peaks of a correlative search, refined by registration.

The search proposes poses far from any prior; registration at two resolutions makes them exact. What cannot become the
best is dropped after the first, so that a place that looks like nothing else costs one refinement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.geometry.registration import Registration, VoxelMap, align
from scanloom.stages.geometry.se3 import F8, inverse, se3_log, transform, yaw_of
from scanloom.stages.geometry.voxels import downsample
from scanloom.stages.loops.columns import pyramid
from scanloom.stages.loops.correlation import Peak, Prior, peaks
from scanloom.stages.loops.indicators import conflict, inliers, upright
from scanloom.stages.loops.submaps import Submap

LOWEST_M = -12.0
"""Of the grid over the ground: it ends at 20 m."""
LIDAR_HEIGHT_M = 1.8
"""Where no ground is labelled."""
GROUND_SPACING_M = 5.0
"""Of the ground of j that counts in the search: it tells heights, and no places."""
LEAST_UPRIGHT = 30
SAME_M, SAME_RAD = 1.0, np.radians(5.0)
DROPPED_SHARE = 0.7
"""A pose that explains less than this share of what the best explains is not refined further."""


class MatchingSettings(BaseModel):
    """How the pose of one submap in another is found."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach_m: float = Field(
        default=10.0, gt=0, le=30, description="half width of the window in x and y around the prior, m"
    )
    reach_z_m: float = Field(default=5.0, gt=0, le=8, description="half height of the window, m")
    reach_yaw_deg: float = Field(
        default=30.0,
        gt=0,
        le=180,
        description="half width of the window in heading; all headings are searched where odometry tells none, deg",
    )
    peaks: int = Field(default=10, ge=1, le=100, description="poses of the search that are refined, at most")
    least_share: float = Field(
        default=0.6, gt=0, le=1, description="peaks below this share of the best score are not refined"
    )
    least_score: float = Field(
        default=0.3, ge=0, le=1, description="peaks below this share of a perfect score are not refined"
    )
    inlier_distance_m: float = Field(
        default=0.3, gt=0, le=5, description="a point with a partner this near is an inlier, m"
    )


class Target:
    """Submap i, ready to be searched and registered to."""

    def __init__(self, submap: Submap) -> None:
        self.submap = submap
        self.coarse = VoxelMap(2.0, 20)
        self.coarse.insert(submap.points)
        self.fine = VoxelMap(1.0, 20)
        self.fine.insert(submap.points)


@dataclass(frozen=True)
class Match:
    """A pose of level frame j in level frame i and how well it explains both submaps."""

    registration: Registration
    fit: float
    """Share of the upright points of j with a partner within the inlier distance."""
    seen_through: float

    @property
    def T(self) -> F8:
        return self.registration.T_target_source

    @property
    def quality(self) -> float:
        """Share of upright points explained, less what free space contradicts."""
        return self.fit * (1.0 - self.seen_through)


def prior_of(
    settings: MatchingSettings, predicted: F8 | None, seen_yaw_rad: float, i: Submap, j: Submap
) -> Prior:
    """Where j is looked for: around odometry's pose, but not farther than the window from i, since places are near.

    `predicted` is T_i_j of the LiDARs, None where odometry tells nothing; `seen_yaw_rad` the heading by descriptors, or NaN.
    All headings are searched without odometry, and where descriptors contradict it.
    """
    reach_yaw = np.radians(settings.reach_yaw_deg)
    if predicted is None:
        z = _ground_z(i) - _ground_z(j)
        return Prior(0.0, 0.0, z, 0.0, settings.reach_m, settings.reach_z_m, np.pi)
    T = inverse(i.T_lidar_level) @ predicted @ j.T_lidar_level
    yaw = float(yaw_of(T))
    if np.isfinite(seen_yaw_rad) and abs((seen_yaw_rad - yaw + np.pi) % (2 * np.pi) - np.pi) > reach_yaw:
        reach_yaw = np.pi
    x, y = T[:2, 3] * min(1.0, settings.reach_m / max(float(np.hypot(T[0, 3], T[1, 3])), 1e-9))
    return Prior(float(x), float(y), float(T[2, 3]), yaw, settings.reach_m, settings.reach_z_m, reach_yaw)


def proposals(settings: MatchingSettings, i: Submap, j: Submap, prior: Prior) -> list[Peak]:
    """Peaks of the correlative search, best first; none where there is nothing upright."""
    low = _ground_z(i) + LOWEST_M
    if len(upright(i)) < LEAST_UPRIGHT or len(upright(j)) < LEAST_UPRIGHT:
        return []
    grid = pyramid(np.vstack((upright(i), i.points[i.ground])), low)
    ground = j.points[j.ground]
    moving = np.vstack((upright(j), ground[downsample(ground, GROUND_SPACING_M)]))
    return peaks(grid, low, moving, prior, settings.peaks, settings.least_share, settings.least_score)


def refined(settings: MatchingSettings, target: Target, j: Submap, found: Sequence[Peak]) -> list[Match]:
    """Distinct poses to which the peaks lead, best first."""
    thin = upright(j)
    thin = thin[downsample(thin, 0.8)]
    reached: list[tuple[float, F8]] = []
    for peak in found:
        T = rough(target, j, peak.T_i_j).T_target_source
        if all(not same(T, other) for _, other in reached):
            reached.append((_fit(settings, target, thin, T), T))
    best = max((fit for fit, _ in reached), default=0.0)
    out: list[Match] = []
    for fit, T in sorted(reached, key=lambda each: -each[0]):
        if fit < DROPPED_SHARE * best:
            break
        r = fine(target.fine, j, T)
        if all(not same(r.T_target_source, other.T) for other in out):
            fit = _fit(settings, target, thin, r.T_target_source)
            out.append(Match(r, fit, conflict(target.submap, j, r.T_target_source)))
    return sorted(out, key=lambda match: -match.quality)


def fine(target: VoxelMap, source: Submap, T: F8) -> Registration:
    """The last registration."""
    return align(target, _thin(source, 0.8), T, max_distance_m=0.8, scale_m=0.15, max_iterations=20)


def itself(own: VoxelMap, submap: Submap) -> Registration:
    """A submap against its own map: residuals as its sensor, its odometry, and the roughness of the place leave them."""
    thin = _thin(submap, 0.8)
    return align(own, thin, np.eye(4), max_distance_m=0.8, scale_m=0.15, max_iterations=1)


def same(a: F8, b: F8) -> bool:
    """Within 1 m and 5 degrees of each other."""
    xi = se3_log(inverse(a) @ b)
    return bool(np.linalg.norm(xi[3:]) <= SAME_M and np.linalg.norm(xi[:3]) <= SAME_RAD)


def rough(target: Target, j: Submap, T: F8) -> Registration:
    """The first registration, which reaches 2 m far."""
    return align(target.coarse, _thin(j, 1.5), T, max_distance_m=2.0, scale_m=0.6, max_iterations=15)


def _thin(submap: Submap, voxel_size_m: float) -> F8:
    return submap.points[downsample(submap.points, voxel_size_m)]


def _fit(settings: MatchingSettings, target: Target, points: F8, T: F8) -> float:
    moved = transform(T, points)
    return float(inliers(target.fine, moved, settings.inlier_distance_m).mean()) if len(points) else 0.0


def _ground_z(submap: Submap) -> float:
    return submap.ground_z_m if np.isfinite(submap.ground_z_m) else -LIDAR_HEIGHT_M
