"""What tells a true loop from a false one, each by itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.registration import Registration
from scanloom.stages.geometry.se3 import F8, inverse, transform
from scanloom.stages.geometry.voxel_map import F4, I4, I8, STEPS, VoxelMap, nearest
from scanloom.stages.geometry.voxels import Float, voxel_keys
from scanloom.stages.loops.freespace import seen_through
from scanloom.stages.loops.submaps import Submap

TALLER_THAN_A_CAR_M = 2.2
"""Cars, people and cyclists stay below: what stands higher is there on another day as well."""
UPRIGHT_M = 0.5
DISPLACED_M = 1.5
LEVEL_NORMAL = 0.8
LEAST_LEVEL = 30
SEEN_M = 3.0
"""Edge of a column in which one point tells that a submap saw what is there."""


def upright(submap: Submap, above_ground_m: float = UPRIGHT_M) -> F8:
    """Points (k, 3) that are no ground and stand higher than this above it."""
    z = submap.ground_z_m if np.isfinite(submap.ground_z_m) else -np.inf
    return submap.points[~submap.ground & (submap.points[:, 2] > z + above_ground_m)]


def inliers(target: VoxelMap, points: F8, distance_m: float) -> NDArray[np.bool_]:
    """Which points (n, 3) have a map point within the distance."""
    out = np.zeros(len(points), np.bool_)
    _near(
        points, distance_m**2, target.voxel_size_m, STEPS, target.keys, target.values, target.count, target.offset, out
    )  # fmt: skip
    return out


def conflict(i: Submap, j: Submap, T_i_j: F8) -> float:
    """Share of the tall structure of one pass that the other's scan looked through, the larger of both directions (E3)."""
    of_i = transform(inverse(T_i_j), upright(i, TALLER_THAN_A_CAR_M))
    of_j = transform(T_i_j, upright(j, TALLER_THAN_A_CAR_M))
    return max(seen_through(j.scan, of_i), seen_through(i.scan, of_j))


def overlap(i: Submap, j: Submap, T_i_j: F8, voxel_size_m: float) -> float:
    """Share of voxels of j that i also fills."""
    of_j = np.unique(voxel_keys(transform(T_i_j, j.points), voxel_size_m))
    return float(np.isin(of_j, voxel_keys(i.points, voxel_size_m)).mean()) if len(of_j) else 0.0


def comparable(i: Submap, points: F8) -> NDArray[np.bool_]:
    """Which of `points` (n, 3) in the frame of i lie where i saw something, ground or not: in one of its filled columns."""
    flat = np.array([1.0, 1.0, 0.0])
    return np.isin(voxel_keys(points * flat, SEEN_M), voxel_keys(i.points * flat, SEEN_M))


def displaced(target: VoxelMap, points: F8, distance_m: float) -> tuple[float, float]:
    """Share of inliers of `points` (n, 3) in the target, and of the copy displaced by 1.5 m that fits best.

    Walls of a tunnel fit anywhere along it.
    """
    here = float(inliers(target, points, distance_m).mean())
    there = 0.0
    for angle in np.radians(np.arange(0, 360, 45)):
        step = DISPLACED_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        there = max(there, float(inliers(target, points + step, distance_m).mean()))
    return here, there


def unevenness_m(r: Registration) -> float:
    """Root mean square residual of ground, and of what else is level, m; of everything where there is little of that.

    Towns repeat houses; the relief of the land under them is a fingerprint.
    """
    level = np.abs(r.normals[:, 2]) > LEVEL_NORMAL
    if level.sum() < LEAST_LEVEL:
        level = np.ones(len(r.normals), np.bool_)
    total = float(r.weights[level].sum())
    return float(np.sqrt((r.weights[level] * r.residuals[level] ** 2).sum() / total)) if total > 0 else np.inf


@kernel
def _near(
    points: F8, limit2: Float, size: Float, steps: I8, keys: I8, values: I4, count: I4, offset: F4,
    out: NDArray[np.bool_],
) -> None:  # fmt: skip
    for n in range(len(points)):
        voxel, _, _ = nearest(
            points[n, 0], points[n, 1], points[n, 2], limit2, size, steps, keys, values, count, offset
        )
        out[n] = voxel >= 0
