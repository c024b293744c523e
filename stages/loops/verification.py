"""Verification of one candidate: is it the same place, and exactly where (methods 1.11).

Matching gives the pose and its rivals. Four indicators judge it: inlier ratio, residual, free-space conflict (E3) and E1.
A loop needs all four; where only two or three agree it is called doubtful, and refused like others, but says so. Beyond
these it must overlap, be distinct, see every direction, show the same relief, agree with its own inverse and odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from scanloom.stages.geometry.degeneracy import Degeneracy, judge
from scanloom.stages.geometry.registration import Registration, VoxelMap
from scanloom.stages.geometry.se3 import F8, inverse, se3_log, transform
from scanloom.stages.geometry.voxels import downsample
from scanloom.stages.loops.candidates import Candidate
from scanloom.stages.loops.correlation import Peak
from scanloom.stages.loops.indicators import comparable, displaced, inliers, overlap, unevenness_m, upright
from scanloom.stages.loops.matching import (
    LEAST_UPRIGHT,
    Match,
    MatchingSettings,
    Target,
    fine,
    itself,
    prior_of,
    proposals,
    refined,
)
from scanloom.stages.loops.submaps import Submap

LEAST_AGREEING = 2
"""Of four indicators, for a loop to be called doubtful and not plainly wrong."""
UNKNOWN_RAD, UNKNOWN_M = np.radians(10.0), 10.0
"""Standard deviation along a direction that the registration did not see (methods 1.8)."""


class VerificationSettings(MatchingSettings):
    """How a loop is measured and what it must pass."""

    max_distance_m: float = Field(
        default=20.0, gt=0, le=100, description="loops between poses farther apart are rejected, m"
    )
    min_inlier_ratio: float = Field(
        default=0.45,
        ge=0,
        le=1,
        description="share of submap j with a partner, of what i saw as well, at least",
    )
    min_structure_ratio: float = Field(
        default=0.35, ge=0, le=1, description="the same of points that are not ground"
    )
    max_rmse_m: float = Field(
        default=0.12, gt=0, le=5, description="root mean square residual of the registration, m"
    )
    max_e1_m: float = Field(
        default=0.05, gt=0, le=5, description="worst standard deviation of translation, m"
    )
    max_seen_through: float = Field(
        default=0.07,
        ge=0,
        le=1,
        description="share of tall structure of one pass that the other looked through",
    )
    min_overlap: float = Field(
        default=0.4, ge=0, le=1, description="share of voxels of submap j that submap i also fills"
    )
    overlap_voxel_m: float = Field(default=1.0, gt=0.1, le=10, description="voxel of the overlap test, m")
    min_direction_p: float = Field(
        default=0.5, ge=0, le=1, description="every direction must be observed beyond noise with this"
    )
    min_contrast: float = Field(
        default=0.2, ge=0, le=1, description="a copy displaced by 1.5 m must lose this share of inliers"
    )
    max_rival: float = Field(
        default=0.7, ge=0, le=1, description="fit of the second-best pose over that of the best, at most"
    )
    max_unevenness: float = Field(
        default=2.3,
        ge=1,
        le=100,
        description="residual of the ground over that which each submap has with itself, at most: the same relief",
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
    drift_sigmas: float = Field(
        default=4.0, gt=0, le=20, description="and so many standard deviations of its relative marginal"
    )
    drift_share: float = Field(
        default=0.005,
        gt=0,
        le=1,
        description="standard deviation of odometry's systematic error, which its covariances do not hold, per metre driven",
    )
    vertical_drift_m: float = Field(
        default=1.0, gt=0, le=100, description="vertical difference always allowed, m"
    )
    vertical_drift_share: float = Field(
        default=0.003, gt=0, le=1, description="the same as drift_share for the height"
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
    seen_through: float
    e1_m: float
    rival: float
    reason: str


@dataclass(frozen=True)
class Drift:
    """What odometry knows of its error between the two keyframes of a candidate."""

    path_m: float
    flat_m: float = 0.0
    """Standard deviation of its relative marginal, the larger one in the horizontal plane."""
    up_m: float = 0.0

    def allowed_m(self, settings: VerificationSettings) -> float:
        """Largest difference from odometry's pose."""
        sigma = np.hypot(self.flat_m, settings.drift_share * self.path_m)
        return float(settings.drift_m + settings.drift_sigmas * sigma)

    def allowed_lift_m(self, settings: VerificationSettings) -> float:
        """Largest difference from odometry's height."""
        sigma = np.hypot(self.up_m, settings.vertical_drift_share * self.path_m)
        return float(settings.vertical_drift_m + settings.drift_sigmas * sigma)


@dataclass(frozen=True)
class Evidence:
    """What is known of the best match: everything that is tested."""

    match: Match
    T_i_j: F8
    inlier_ratio: float
    structure_ratio: float
    overlap: float
    seen: Degeneracy
    rival: float
    rival_m: float
    """How far the second-best pose lies from the best."""

    @property
    def registration(self) -> Registration:
        return self.match.registration


def verify(settings: VerificationSettings, c: Candidate, drift: Drift, i: Submap, j: Submap) -> Verdict:
    """Pose of LiDAR j in LiDAR i and whether to believe it. `drift` is not looked at where odometry predicts nothing."""
    if c.predicted is not None:
        far = float(np.linalg.norm(c.predicted[:3, 3])) - settings.max_distance_m
        if far > drift.allowed_m(settings):
            return _nothing(f"contradicts odometry by more than {far:.0f} m after {drift.path_m:.0f} m")
    prior = prior_of(settings, c.predicted, c.yaw_rad, i, j)
    return decide(settings, c, drift, i, j, proposals(settings, i, j, prior))


def decide(
    settings: VerificationSettings, c: Candidate, drift: Drift, i: Submap, j: Submap, found: Sequence[Peak]
) -> Verdict:
    """The second stage alone: what becomes of the peaks that the search has found."""
    if not found:
        bare = min(len(upright(i)), len(upright(j))) < LEAST_UPRIGHT
        return _nothing("nothing upright to compare" if bare else "nowhere do the submaps look alike")
    target = Target(i)
    e = _evidence(settings, refined(settings, target, j, found), target, j)
    reason = _refusal(settings, e, c, drift, target, j)
    r = e.registration
    return Verdict(
        e.T_i_j, _covariance(settings, r, j), e.inlier_ratio, r.rmse_m, e.overlap, e.match.seen_through, e.seen.e_m,
        e.rival, reason,
    )  # fmt: skip


def _nothing(reason: str) -> Verdict:
    nan = float("nan")
    return Verdict(np.eye(4), np.eye(6), 0.0, nan, 0.0, nan, nan, nan, reason)


def _evidence(settings: VerificationSettings, matches: list[Match], target: Target, j: Submap) -> Evidence:
    best = matches[0]
    thin = downsample(j.points, 0.6)
    moved, ground = transform(best.T, j.points[thin]), j.ground[thin]
    seen = comparable(target.submap, moved)
    moved, ground = moved[seen], ground[seen]
    inlier = inliers(target.fine, moved, settings.inlier_distance_m)
    structure = inlier[~ground]
    rival, rival_m = 0.0, 0.0
    if len(matches) > 1 and best.quality > 0:
        rival = matches[1].quality / best.quality
        rival_m = float(np.linalg.norm((inverse(best.T) @ matches[1].T)[:3, 3]))
    return Evidence(
        match=best,
        T_i_j=target.submap.T_lidar_level @ best.T @ inverse(j.T_lidar_level),
        inlier_ratio=float(inlier.mean()) if len(inlier) else 0.0,
        structure_ratio=float(structure.mean()) if len(structure) else 0.0,
        overlap=overlap(target.submap, j, best.T, settings.overlap_voxel_m),
        seen=judge(best.registration),
        rival=rival,
        rival_m=rival_m,
    )


def _refusal(
    settings: VerificationSettings, e: Evidence, c: Candidate, drift: Drift, target: Target, j: Submap
) -> str:
    """Why not to believe it; empty when there is nothing to say. Costly tests come last."""
    doubts = _doubts(settings, e)
    reason = _unfit(settings, e) or _implausible(settings, c, drift, e.T_i_j)
    if len(doubts) > 4 - LEAST_AGREEING:
        return doubts[0]
    reason = reason or _indistinct(settings, target, j, e.match.T)
    if not reason:
        own = VoxelMap(1.0, 20)
        own.insert(j.points)
        reason = _one_sided(settings, own, target, e.match.T) or _other_ground(settings, e, own, target, j)
    if reason or not doubts:
        return reason
    return f"doubtful, {4 - len(doubts)} of 4 indicators agree: {doubts[0]}"


def _doubts(settings: VerificationSettings, e: Evidence) -> list[str]:
    """What the four indicators say against it."""
    conflict = e.match.seen_through
    rmse = e.registration.rmse_m
    tests = (
        (
            e.inlier_ratio >= settings.min_inlier_ratio,
            f"only {e.inlier_ratio:.0%} of the points find a partner",
        ),
        (rmse <= settings.max_rmse_m, f"residuals of {rmse:.2f} m are too large"),
        (
            conflict <= settings.max_seen_through,
            f"{conflict:.0%} of the structure of one pass was seen through on the other",
        ),
        (e.seen.e_m <= settings.max_e1_m, f"translation is known to {e.seen.e_m:.2f} m only"),
    )
    return [text for passed, text in tests if not passed]


def _unfit(settings: VerificationSettings, e: Evidence) -> str:
    """The first other property of the match that a loop must have and this one has not."""
    apart = float(np.linalg.norm(e.T_i_j[:3, 3]))
    tests = (
        (e.registration.converged, "registration did not converge"),
        (apart <= settings.max_distance_m, f"poses are {apart:.0f} m apart"),
        (
            e.structure_ratio >= settings.min_structure_ratio,
            f"only {e.structure_ratio:.0%} of the upright points find a partner",
        ),
        (e.overlap >= settings.min_overlap, f"submaps overlap by {e.overlap:.0%} only"),
        (
            e.seen.p.min() >= settings.min_direction_p,
            "degenerate: a direction is not observed beyond noise",
        ),
        (
            e.rival <= settings.max_rival,
            f"ambiguous: another pose {e.rival_m:.1f} m away fits {e.rival:.0%} as well",
        ),
    )
    return next((text for passed, text in tests if not passed), "")


def _implausible(settings: VerificationSettings, c: Candidate, drift: Drift, T_i_j: F8) -> str:
    """Odometry drifts, but not that far; above all it tells the decks of a bridge apart."""
    if c.predicted is None:
        return ""
    off = float(np.linalg.norm((inverse(c.predicted) @ T_i_j)[:3, 3]))
    if off > drift.allowed_m(settings):
        return f"contradicts odometry by {off:.1f} m after {drift.path_m:.0f} m"
    lift = abs(float(T_i_j[2, 3] - c.predicted[2, 3]))
    if lift > drift.allowed_lift_m(settings):
        return f"contradicts odometry's height by {lift:.1f} m after {drift.path_m:.0f} m"
    return ""


def _indistinct(settings: VerificationSettings, target: Target, j: Submap, T: F8) -> str:
    """A copy displaced by 1.5 m in any horizontal direction must lose inliers."""
    standing = j.points[~j.ground]
    here, there = displaced(
        target.fine, transform(T, standing[downsample(standing, 0.6)]), settings.inlier_distance_m / 2
    )
    if here - there < settings.min_contrast * here:
        return f"not distinct: a copy displaced by 1.5 m fits {there:.0%} instead of {here:.0%}"
    return ""


def _one_sided(settings: VerificationSettings, own: VoxelMap, target: Target, T: F8) -> str:
    """Registration of i to j, whose own map this is, must give the inverse."""
    back = fine(own, target.submap, inverse(T))
    difference = se3_log(T @ back.T_target_source)
    turn, shift = float(np.degrees(np.linalg.norm(difference[:3]))), float(np.linalg.norm(difference[3:]))
    if not back.converged or shift > settings.max_disagreement_m or turn > settings.max_disagreement_deg:
        return f"forward and backward registration disagree by {shift:.2f} m, {turn:.1f} deg"
    return ""


def _other_ground(
    settings: VerificationSettings, e: Evidence, own: VoxelMap, target: Target, j: Submap
) -> str:
    """The relief of both passes must agree as well as passes do, measured by each of the two."""
    here = unevenness_m(e.registration)
    usual = max(unevenness_m(itself(own, j)), unevenness_m(itself(target.fine, target.submap)))
    if here > settings.max_unevenness * usual:
        return (
            f"another relief: the ground differs by {100 * here:.1f} cm where {100 * usual:.1f} cm are usual"
        )
    return ""


def _covariance(settings: VerificationSettings, r: Registration, j: Submap) -> F8:
    """sigma2 H^-1 plus floors (methods 1.8), moved from the level frame of j to its LiDAR."""
    scale = np.repeat([np.radians(settings.floor_deg), settings.floor_m], 3) ** 2
    H = r.information / max(r.sigma2, 1e-12)
    regular = H + np.diag(1.0 / np.repeat([UNKNOWN_RAD, UNKNOWN_M], 3) ** 2)
    R = np.kron(np.eye(2), j.T_lidar_level[:3, :3])
    covariance = R @ (np.linalg.inv(regular) + np.diag(scale)) @ R.T
    return np.asarray(0.5 * (covariance + covariance.T))
