"""Odometry and the map's poses of one session against truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.evaluation import ErrorTrack
from scanloom.schemas.frames import Georeference
from scanloom.schemas.trajectory import Odometry, Poses, Truth
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.geodesy import between_worlds
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8, inverse

RPE_LENGTHS_M = (1, 5, 10, 20)


def trajectory_figures(odometry: Odometry, poses: Poses) -> Iterator[Figure]:
    """What can be said of a session without truth."""
    yield Figure("odometry.scans", len(odometry), "", "scans with a pose from odometry")
    unreliable = int(np.count_nonzero(~odometry.reliable))
    yield Figure("odometry.unreliable_scans", unreliable, "", "scans whose motion was bridged by prediction")
    for name, T in (("odometry", odometry.T_odom_lidar), ("fusion", poses.T_world_lidar)):
        if len(T):
            length = float(alignment.travelled(T)[-1])
            yield Figure(f"{name}.path_length_m", length, "m", "sum of the distances from scan to scan")


def truth_figures(truth: Truth, odometry: Odometry, poses: Poses) -> Iterator[Figure]:
    """Errors against truth; truth is interpolated to the scans, scans outside its time range are left out."""
    for name, stamp_ns, T in _estimates(odometry, poses):
        covered = inside(truth.stamp_ns, stamp_ns)
        if np.count_nonzero(covered) < 2:
            continue
        true = interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, stamp_ns[covered])
        if name == "fusion":
            yield from _coverage(true, covered, truth.source)
        yield from _error_figures(name, true, T[covered])
        if name == "fusion":
            yield from _map_figures(truth, true, poses.take(covered))


def _map_figures(truth: Truth, true: F8, poses: Poses) -> Iterator[Figure]:
    """Errors on the Earth, and whether the marginal covariances tell the truth of the errors."""
    T_world_truth = on_earth(truth, poses)
    if T_world_truth is None:
        T_world_truth = alignment.umeyama(poses.T_world_lidar[:, :3, 3], true[:, :3, 3])
        how = "truth aligned as a whole"
    else:
        how = "nothing aligned"
        moved = (T_world_truth @ true)[:, :3, 3]
        yield from _absolute_figures(np.linalg.norm(moved - poses.T_world_lidar[:, :3, 3], axis=1))
    yield _honesty(T_world_truth @ true, poses.T_world_lidar, poses.covariance, how)


def error_track(truth: Truth, odometry: Odometry, poses: Poses) -> ErrorTrack | None:
    """Errors scan by scan where odometry, map and truth all have the scan; None without such scans."""
    _, at_odometry, at_poses = np.intersect1d(odometry.scan_index, poses.scan_index, return_indices=True)
    stamp_ns = odometry.stamp_ns[at_odometry]
    covered = inside(truth.stamp_ns, stamp_ns)
    if not covered.any():
        return None
    true = interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, stamp_ns[covered])
    return ErrorTrack(
        stamp_ns=stamp_ns[covered],
        travelled_m=alignment.travelled(true),
        odometry_error_m=alignment.errors_from_start(true, odometry.T_odom_lidar[at_odometry][covered]),
        fusion_error_m=alignment.absolute_errors(true, poses.T_world_lidar[at_poses][covered]),
    )


def _estimates(odometry: Odometry, poses: Poses) -> Iterator[tuple[str, NDArray[np.int64], F8]]:
    yield "odometry", odometry.stamp_ns, odometry.T_odom_lidar
    yield "fusion", poses.stamp_ns, poses.T_world_lidar


def _coverage(true: F8, covered: NDArray[np.bool_], source: str) -> Iterator[Figure]:
    length = float(alignment.travelled(true)[-1])
    method = f"sum of the distances from scan to scan; truth: {source or 'of unnamed origin'}"
    if length < alignment.KITTI_LENGTHS_M[0]:
        method += "; KITTI t_rel and r_rel need segments of 100 m and are left out"
    yield Figure("truth.path_length_m", length, "m", method)
    yield Figure("truth.scans", int(covered.sum()), "", "scans within the time range of truth")
    yield Figure(
        "truth.scans_outside", int((~covered).sum()), "", "scans outside the time range of truth, left out"
    )


def _error_figures(name: str, true: F8, estimate: F8) -> Iterator[Figure]:
    errors = alignment.absolute_errors(true, estimate)
    how = "distance to truth after one rigid alignment of all positions (Umeyama, no scale)"
    n = len(errors)
    yield Figure(f"{name}.ate_rmse_m", alignment.rms(errors), "m", f"root mean square {how}", samples=n)
    yield Figure(f"{name}.ate_max_m", float(errors.max()), "m", f"largest {how}", samples=n)
    for length in RPE_LENGTHS_M:
        relative = alignment.relative_errors(true, estimate, float(length))
        if len(relative):
            how = f"root mean square error of the motion over {length} m of path, from every scan"
            metres, degrees = relative.translation_m, np.degrees(relative.rotation_rad)
            n = len(relative)
            yield Figure(f"{name}.rpe{length}_m", alignment.rms(metres), "m", how, samples=n)
            yield Figure(f"{name}.rpe{length}_deg", alignment.rms(degrees), "deg", how, samples=n)
    kitti = alignment.kitti_errors(true, estimate)
    if kitti:
        how = f"KITTI odometry benchmark: mean over {kitti.segments} segments of 100 to 800 m from every tenth scan"
        yield Figure(f"{name}.kitti_t_rel_percent", kitti.t_rel_percent, "%", how)
        yield Figure(f"{name}.kitti_r_rel_deg_per_100m", kitti.r_rel_deg_per_100m, "deg/100m", how)


def _absolute_figures(errors: F8) -> Iterator[Figure]:
    how = "distance to truth on the Earth, nothing aligned"
    n = len(errors)
    yield Figure("fusion.absolute_rmse_m", alignment.rms(errors), "m", f"root mean square {how}", samples=n)
    yield Figure("fusion.absolute_max_m", float(errors.max()), "m", f"largest {how}", samples=n)


def on_earth(truth: Truth, poses: Poses) -> F8 | None:
    """T_world_truth (4, 4) where both the map and truth stand on the Earth, else None."""
    if poses.georeference is None or truth.georeference is None:
        return None
    return between_worlds(Georeference(**poses.georeference), Georeference(**truth.georeference))


def _honesty(true: F8, estimate: F8, covariance: F8, how: str) -> Figure:
    """Mean of e^T C^-1 e over the poses, e the error of position in the LiDAR's frame (Bar-Shalom et al. 2001, 5.4)."""
    error = (inverse(estimate) @ true)[:, :3, 3]
    C = covariance[:, 3:, 3:]
    usable = np.asarray(np.isfinite(C).all(axis=(1, 2)))
    usable[usable] = np.linalg.det(C[usable]) > 0
    error, C = error[usable], C[usable]
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(C, error[..., None])[..., 0])
    method = (
        f"mean squared error of position over its marginal covariance, {how}; 3 is honest, more is too sure"
    )
    mean = float(squared.mean()) if len(squared) else np.nan
    return Figure("fusion.nees_translation", mean, "", method, samples=len(squared))
