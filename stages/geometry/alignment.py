"""How far one trajectory is from another: alignment, absolute, relative and KITTI errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_log, transform

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP = 10


def umeyama(target: F8, source: F8) -> F8:
    """Rigid motion T_target_source (4, 4) that minimises sum |target_i - T source_i|^2, without scale.

    target, source : (n, 3), m, row by row the same points. Umeyama 1991, eq. 34 to 43 with c = 1. When the points lie
    on a line or in one place, the free rotation is the one that turns least.
    """
    mean_t, mean_s = target.mean(axis=0), source.mean(axis=0)
    covariance = (target - mean_t).T @ (source - mean_s)
    U, _, Vt = np.linalg.svd(covariance)
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ S @ Vt
    return pose(R, mean_t - R @ mean_s)


def travelled(T: F8) -> F8:
    """Path length (n,) from the first pose to each pose of T (n, 4, 4), m."""
    steps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def absolute_errors(truth: F8, estimate: F8) -> F8:
    """Distance (n,) of every position to truth after the best rigid alignment of the whole, m."""
    t, e = truth[:, :3, 3], estimate[:, :3, 3]
    distance: F8 = np.linalg.norm(t - transform(umeyama(t, e), e), axis=1)
    return distance


def errors_from_start(truth: F8, estimate: F8) -> F8:
    """Distance (n,) of every position to truth when the first poses are laid over each other, m."""
    moved = truth[0] @ inverse(estimate[0]) @ estimate
    distance: F8 = np.linalg.norm(truth[:, :3, 3] - moved[:, :3, 3], axis=1)
    return distance


def rms(values: F8) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True)
class RelativeErrors:
    """Error of the motion over segments: one entry per segment, empty when the path is too short."""

    translation_m: F8
    rotation_rad: F8
    length_m: F8

    def __len__(self) -> int:
        return len(self.length_m)


def relative_errors(truth: F8, estimate: F8, length_m: float, *, step: int = 1) -> RelativeErrors:
    """Errors over all segments of a given path length that start at every `step`-th pose.

    A segment ends at the first pose whose distance along the true path exceeds its start's by `length_m`, as in
    KITTI's `evaluate_odometry.cpp`. Its error is (estimated motion)^-1 (true motion).
    """
    path = travelled(truth)
    first = np.arange(0, len(truth), step)
    last = np.searchsorted(path, path[first] + length_m, side="right")
    first, last = first[last < len(truth)], last[last < len(truth)]
    if len(first) == 0:
        return RelativeErrors(np.empty(0), np.empty(0), np.empty(0))
    true_motion = inverse(truth[first]) @ truth[last]
    error = inverse(inverse(estimate[first]) @ estimate[last]) @ true_motion
    return RelativeErrors(
        translation_m=np.linalg.norm(error[:, :3, 3], axis=1),
        rotation_rad=np.linalg.norm(so3_log(error[:, :3, :3]), axis=1),
        length_m=np.full(len(first), length_m),
    )


@dataclass(frozen=True)
class KittiErrors:
    """KITTI odometry benchmark: drift in per cent and degrees per 100 m, over so many segments."""

    t_rel_percent: float
    r_rel_deg_per_100m: float
    segments: int


def kitti_errors(truth: F8, estimate: F8) -> KittiErrors | None:
    """Mean drift over all segments of 100, 200, ... 800 m from every tenth pose; None for paths under 100 m.

    Geiger, Lenz, Urtasun, CVPR 2012; poses (n, 4, 4) of the same frame at the same times, at about 10 Hz.
    """
    sets = [relative_errors(truth, estimate, length, step=KITTI_STEP) for length in KITTI_LENGTHS_M]
    sets = [errors for errors in sets if len(errors)]
    if not sets:
        return None
    t = np.concatenate([errors.translation_m / errors.length_m for errors in sets])
    r = np.concatenate([errors.rotation_rad / errors.length_m for errors in sets])
    return KittiErrors(float(100 * t.mean()), float(np.degrees(r.mean()) * 100), len(t))


def motion_error(T_true: F8, T_estimated: F8) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Translation (n,), m, and rotation (n,), rad, between true and estimated relative poses (n, 4, 4)."""
    error = inverse(T_true) @ T_estimated
    return np.linalg.norm(error[..., :3, 3], axis=-1), np.linalg.norm(so3_log(error[..., :3, :3]), axis=-1)
