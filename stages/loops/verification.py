"""Geometric verification of one candidate: is it the same place, and exactly where (methods 1.11).

Coarse correlation proposes poses, registration at two resolutions refines them, and independent indicators decide:
residuals, overlap, conditioning (E1, DRPM), distinctness (a displaced copy must fit clearly worse: walls of a tunnel
fit anywhere along it), agreement of the registration in both directions, and plausibility against odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.geometry.degeneracy import judge
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.registration import Registration, VoxelMap, align
from scanloom.stages.geometry.se3 import F8, inverse, se3_log, transform, yaw_of
from scanloom.stages.geometry.voxel_map import STEPS, nearest
from scanloom.stages.geometry.voxels import downsample, voxel_keys
from scanloom.stages.loops.candidates import Candidate
from scanloom.stages.loops.coarse import Hypothesis, hypotheses
from scanloom.stages.loops.freespace import seen_through
from scanloom.stages.loops.submaps import Submap

TALLER_THAN_A_CAR_M = 2.2
"""Cars, people and cyclists stay below: what stands higher is there on another day as well."""


class VerificationSettings(BaseModel):
    """What a loop must pass."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach_m: float = Field(default=14.0, gt=0, le=100, description="largest translation that is searched, m")
    max_distance_m: float = Field(
        default=12.0, gt=0, le=100, description="loops between poses farther apart are rejected, m"
    )
    hypotheses: int = Field(default=3, ge=1, le=50, description="coarse poses that are refined")
    inlier_distance_m: float = Field(
        default=0.3, gt=0, le=5, description="a point with a partner this near is an inlier, m"
    )
    min_inlier_ratio: float = Field(
        default=0.55, ge=0, le=1, description="share of submap j with a partner, at least"
    )
    min_structure_ratio: float = Field(
        default=0.35, ge=0, le=1, description="the same of points that are not ground"
    )
    max_rmse_m: float = Field(
        default=0.12, gt=0, le=5, description="root mean square residual of the registration, m"
    )
    min_overlap: float = Field(
        default=0.4, ge=0, le=1, description="share of voxels of submap j that submap i also fills"
    )
    overlap_voxel_m: float = Field(default=1.0, gt=0.1, le=10, description="voxel of the overlap test, m")
    max_e1_m: float = Field(
        default=0.05, gt=0, le=5, description="worst standard deviation of translation, m"
    )
    min_direction_p: float = Field(
        default=0.5, ge=0, le=1, description="every direction must be observed beyond noise with this"
    )
    min_contrast: float = Field(
        default=0.2, ge=0, le=1, description="a copy displaced by 1.5 m must lose this share of inliers"
    )
    max_rival: float = Field(
        default=0.85, ge=0, le=1, description="fit of the second-best pose over that of the best, at most"
    )
    max_seen_through: float = Field(
        default=0.035,
        ge=0,
        le=1,
        description="share of tall structure of one pass that the other looked through",
    )
    max_disagreement_m: float = Field(
        default=0.25, gt=0, le=5, description="forward against backward registration, m"
    )
    max_disagreement_deg: float = Field(
        default=1.0, gt=0, le=90, description="forward against backward registration, deg"
    )
    drift_m: float = Field(
        default=3.0, gt=0, le=100, description="difference from odometry always allowed, m"
    )
    drift_share: float = Field(
        default=0.04, gt=0, le=1, description="difference from odometry allowed per metre driven"
    )
    vertical_drift_m: float = Field(
        default=1.0, gt=0, le=100, description="vertical difference always allowed, m"
    )
    vertical_drift_share: float = Field(
        default=0.015, gt=0, le=1, description="vertical difference allowed per metre driven"
    )
    floor_m: float = Field(
        default=0.05, gt=0, le=5, description="smallest standard deviation of a loop's translation, m"
    )
    floor_deg: float = Field(
        default=0.2, gt=0, le=90, description="smallest standard deviation of a loop's rotation, deg"
    )


@dataclass(frozen=True)
class Verdict:
    """Result for one candidate. `reason` is empty when every test passed."""

    T_i_j: F8
    covariance: F8
    inlier_ratio: float
    rmse_m: float
    overlap: float
    reason: str


def verify(settings: VerificationSettings, c: Candidate, path_m: float, i: Submap, j: Submap) -> Verdict:
    """Pose of LiDAR j in LiDAR i and whether to believe it. `path_m` is the path driven in between (0 between sessions)."""
    proposals = hypotheses(i, j, _headings(c, i, j), settings.reach_m, settings.hypotheses)
    if not proposals:
        return _rejected("nothing upright to compare")
    maps = _Maps(i)
    tried = [_rough(maps, j, h) for h in proposals]
    fits = [_upright_fit(settings, maps, j, r) for r in tried]
    best = int(np.argmax(fits))
    verdict = _judge(settings, c, path_m, i, j, maps, _fine(maps.fine, j, tried[best].T_target_source))
    if not verdict.reason:
        verdict = replace(verdict, reason=_ambiguous(settings, tried, fits, best))
    return verdict


def _upright_fit(settings: VerificationSettings, maps: _Maps, j: Submap, r: Registration) -> float:
    """Share of the upright points of j that find a partner."""
    upright = _upright(j)
    thin = upright[downsample(upright, 0.8)]
    if not len(thin):
        return 0.0
    return float(_inliers(maps.fine, transform(r.T_target_source, thin), settings.inlier_distance_m).mean())


def _ambiguous(
    settings: VerificationSettings, tried: Sequence[Registration], fits: Sequence[float], best: int
) -> str:
    """A second pose that fits nearly as well: the place repeats itself."""
    for r, fit in zip(tried, fits, strict=True):
        apart = se3_log(inverse(tried[best].T_target_source) @ r.T_target_source)
        other = np.linalg.norm(apart[3:]) > 1.0 or np.linalg.norm(apart[:3]) > np.radians(5.0)
        if other and fit > settings.max_rival * fits[best]:
            return f"ambiguous: another pose {np.linalg.norm(apart[3:]):.1f} m away fits {fit:.0%} against {fits[best]:.0%}"
    return ""


def _rejected(reason: str) -> Verdict:
    return Verdict(np.eye(4), np.eye(6), 0.0, float("nan"), 0.0, reason)


def _headings(c: Candidate, i: Submap, j: Submap) -> F8:
    """Around the descriptor's heading, its opposite (same road, other direction), and odometry's."""
    fine = np.radians([-6.0, -3.0, 0.0, 3.0, 6.0])
    out = []
    if np.isfinite(c.yaw_rad):
        out += [c.yaw_rad + fine, c.yaw_rad + np.pi + fine]
    if c.predicted is not None:
        out.append(
            float(yaw_of(inverse(i.T_lidar_level) @ c.predicted @ j.T_lidar_level))
            + np.append(fine, [-10.0, 10.0])
        )
    return np.concatenate(out)


class _Maps:
    """Submap i at two resolutions."""

    def __init__(self, submap: Submap) -> None:
        self.coarse = VoxelMap(2.0, 20)
        self.coarse.insert(submap.points)
        self.fine = VoxelMap(1.0, 20)
        self.fine.insert(submap.points)


def _rough(maps: _Maps, j: Submap, h: Hypothesis) -> Registration:
    return align(maps.coarse, _thin(j, 1.5), h.T_i_j, max_distance_m=2.0, scale_m=0.6, max_iterations=15)


def _fine(target: VoxelMap, source: Submap, T: F8) -> Registration:
    return align(target, _thin(source, 0.8), T, max_distance_m=0.8, scale_m=0.15, max_iterations=20)


def _thin(submap: Submap, voxel_size_m: float) -> F8:
    return submap.points[downsample(submap.points, voxel_size_m)]


def _judge(
    settings: VerificationSettings, c: Candidate, path_m: float, i: Submap, j: Submap, maps: _Maps, r: Registration
) -> Verdict:  # fmt: skip
    T = r.T_target_source
    T_i_j = i.T_lidar_level @ T @ inverse(j.T_lidar_level)
    thin = downsample(j.points, 0.6)
    points, ground = j.points[thin], j.ground[thin]
    inlier = _inliers(maps.fine, transform(T, points), settings.inlier_distance_m)
    overlap = _overlap(i.points, transform(T, j.points), settings.overlap_voxel_m)
    structure = float(inlier[~ground].mean()) if (~ground).any() else 0.0
    seen = judge(r)
    reason = _first_failure(
        [
            (not r.converged, "registration did not converge"),
            (
                np.linalg.norm(T_i_j[:3, 3]) > settings.max_distance_m,
                f"poses are {np.linalg.norm(T_i_j[:3, 3]):.0f} m apart",
            ),
            (
                inlier.mean() < settings.min_inlier_ratio,
                f"only {inlier.mean():.0%} of the points find a partner",
            ),
            (
                structure < settings.min_structure_ratio,
                f"only {structure:.0%} of the upright points find a partner",
            ),
            (not r.rmse_m <= settings.max_rmse_m, f"residuals of {r.rmse_m:.2f} m are too large"),
            (overlap < settings.min_overlap, f"submaps overlap by {overlap:.0%} only"),
            (seen.e_m > settings.max_e1_m, f"translation is known to {seen.e_m:.2f} m only"),
            (seen.p.min() < settings.min_direction_p, "degenerate: a direction is not observed beyond noise"),
        ]
    )
    reason = reason or _implausible(settings, c, path_m, T_i_j)
    reason = reason or _indistinct(settings, maps, points[~ground], T)
    reason = reason or _transparent(settings, i, j, T)
    reason = reason or _one_sided(settings, i, j, T)
    return Verdict(T_i_j, _covariance(settings, r, j), float(inlier.mean()), r.rmse_m, overlap, reason)


def _first_failure(tests: list[tuple[bool | np.bool_, str]]) -> str:
    return next((text for failed, text in tests if failed), "")


def _implausible(settings: VerificationSettings, c: Candidate, path_m: float, T_i_j: F8) -> str:
    """Odometry drifts, but not that far; above all it tells the decks of a bridge apart."""
    if c.predicted is None:
        return ""
    difference = inverse(c.predicted) @ T_i_j
    off = float(np.linalg.norm(difference[:3, 3]))
    if off > settings.drift_m + settings.drift_share * path_m:
        return f"contradicts odometry by {off:.1f} m after {path_m:.0f} m"
    lift = abs(float(T_i_j[2, 3] - c.predicted[2, 3]))
    if lift > settings.vertical_drift_m + settings.vertical_drift_share * path_m:
        return f"contradicts odometry's height by {lift:.1f} m after {path_m:.0f} m"
    return ""


def _indistinct(settings: VerificationSettings, maps: _Maps, upright: F8, T: F8) -> str:
    """A copy displaced by 1.5 m in any horizontal direction must lose inliers."""
    if not len(upright):
        return "nothing upright to compare"
    moved = transform(T, upright)
    near = settings.inlier_distance_m / 2
    here = float(_inliers(maps.fine, moved, near).mean())
    for angle in np.radians(np.arange(0, 360, 45)):
        step = 1.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
        there = float(_inliers(maps.fine, moved + step, near).mean())
        if here - there < settings.min_contrast * here:
            return f"not distinct: a copy displaced by 1.5 m fits {there:.0%} instead of {here:.0%}"
    return ""


def _transparent(settings: VerificationSettings, i: Submap, j: Submap, T: F8) -> str:
    """Structure of one pass that the other one's scan looked through; only what is too tall to have driven away."""
    of_i = transform(inverse(T), _upright(i, TALLER_THAN_A_CAR_M))
    of_j = transform(T, _upright(j, TALLER_THAN_A_CAR_M))
    conflict = max(seen_through(j.scan, of_i), seen_through(i.scan, of_j))
    if conflict > settings.max_seen_through:
        return f"{conflict:.0%} of the structure of one pass was seen through on the other"
    return ""


def _upright(submap: Submap, above_ground_m: float = 0.5) -> F8:
    z = submap.ground_z_m if np.isfinite(submap.ground_z_m) else -np.inf
    return submap.points[~submap.ground & (submap.points[:, 2] > z + above_ground_m)]


def _one_sided(settings: VerificationSettings, i: Submap, j: Submap, T: F8) -> str:
    """Registration of i to j must give the inverse."""
    other = VoxelMap(1.0, 20)
    other.insert(j.points)
    back = _fine(other, i, inverse(T))
    difference = se3_log(T @ back.T_target_source)
    turn, shift = float(np.degrees(np.linalg.norm(difference[:3]))), float(np.linalg.norm(difference[3:]))
    if not back.converged or shift > settings.max_disagreement_m or turn > settings.max_disagreement_deg:
        return f"forward and backward registration disagree by {shift:.2f} m, {turn:.1f} deg"
    return ""


def _covariance(settings: VerificationSettings, r: Registration, j: Submap) -> F8:
    """sigma2 H^-1 plus floors (methods 1.8), moved from the level frame of j to its LiDAR."""
    scale = np.repeat([np.radians(settings.floor_deg), settings.floor_m], 3) ** 2
    H = r.information / max(r.sigma2, 1e-12)
    regular = H + np.diag(1.0 / np.repeat([np.radians(10.0), 10.0], 3) ** 2)
    R = np.kron(np.eye(2), j.T_lidar_level[:3, :3])
    covariance = R @ (np.linalg.inv(regular) + np.diag(scale)) @ R.T
    return np.asarray(0.5 * (covariance + covariance.T))


def _overlap(points_i: F8, points_j_in_i: F8, voxel_size_m: float) -> float:
    """Share of voxels of j that i also fills."""
    of_j = np.unique(voxel_keys(points_j_in_i, voxel_size_m))
    return float(np.isin(of_j, voxel_keys(points_i, voxel_size_m)).mean())


def _inliers(target: VoxelMap, points: F8, distance_m: float) -> NDArray[np.bool_]:
    """Which points (n, 3) have a map point within the distance."""
    out = np.zeros(len(points), np.bool_)
    _near(
        points,
        distance_m**2,
        target.voxel_size_m,
        STEPS,
        target.keys,
        target.values,
        target.count,
        target.offset,
        out,
    )
    return out


@kernel
def _near(
    points: F8, limit2: float, size: float, steps: NDArray[np.int64], keys: NDArray[np.int64],
    values: NDArray[np.int32], count: NDArray[np.int32], offset: NDArray[np.float32], out: NDArray[np.bool_],
) -> None:  # fmt: skip
    for n in range(len(points)):
        voxel, _, _ = nearest(
            points[n, 0], points[n, 1], points[n, 2], limit2, size, steps, keys, values, count, offset
        )
        out[n] = voxel >= 0
