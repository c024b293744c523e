"""Submaps around keyframes: what is compared to verify a loop. Clouds are read when needed and few are kept."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8, inverse, pose, transform
from scanloom.stages.geometry.voxels import downsample
from scanloom.stages.loops.candidates import Track
from scanloom.stages.loops.places import FIRST_LEFT_OUT
from scanloom.stages.loops.reading import ScanShelf

KEPT_CLOUDS = 40
LEVEL_RADIUS_M = 20.0


class SubmapSettings(BaseModel):
    """What a submap is made of."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach_m: float = Field(default=12.0, ge=0, le=200, description="path before and after the keyframe, m")
    step_m: float = Field(default=3.0, gt=0, le=100, description="one scan per this much path, m")
    max_range_m: float = Field(
        default=45.0, gt=5, le=300, description="points farther from their LiDAR are left out, m"
    )
    voxel_size_m: float = Field(
        default=0.3, gt=0.05, le=5, description="points are thinned to one per voxel of this size, m"
    )


@dataclass(frozen=True)
class Submap:
    """Points (n, 3), m, in the levelled frame of its keyframe: origin at the LiDAR, z along the normal of the ground."""

    points: F8
    ground: NDArray[np.bool_]
    T_lidar_level: F8
    ground_z_m: float
    """Height of the ground under the LiDAR; NaN when no ground is labelled."""
    scan: F8
    """Points (k, 3) of the keyframe's own scan, for tests of what it saw through."""


class SubmapShelf:
    """Builds submaps; keeps the thinned clouds of the last few scans it read."""

    def __init__(
        self, settings: SubmapSettings, tracks: Sequence[Track], shelves: Sequence[ScanShelf]
    ) -> None:
        self._settings = settings
        self._tracks = tracks
        self._shelves = shelves
        self._clouds: OrderedDict[tuple[int, int], tuple[F8, NDArray[np.bool_]]] = OrderedDict()

    def around(self, track: int, keyframe: int) -> Submap:
        """The submap around one keyframe, from odometry's relative poses."""
        t = self._tracks[track]
        to_here = inverse(t.T_odom_lidar[keyframe])
        points, ground = [], []
        for k in self._members(t, keyframe):
            cloud, is_ground = self._cloud(track, int(k))
            points.append(transform(to_here @ t.T_odom_lidar[k], cloud))
            ground.append(is_ground)
        merged, flags = np.concatenate(points), np.concatenate(ground)
        kept = downsample(merged, self._settings.voxel_size_m)
        return _levelled(merged[kept], flags[kept], self._cloud(track, keyframe)[0])

    def _members(self, t: Track, keyframe: int) -> list[int]:
        """The keyframe itself and others every `step_m` on both sides."""
        path = t.travelled_m - t.travelled_m[keyframe]
        near = np.flatnonzero(np.abs(path) <= self._settings.reach_m)
        cell = np.round(path[near] / self._settings.step_m)
        off = np.abs(path[near] - cell * self._settings.step_m) + np.where(near == keyframe, -1.0, 0.0)
        members = []
        for c in np.unique(cell):
            inside = near[cell == c]
            members.append(int(inside[np.argmin(off[cell == c])]))
        return members

    def _cloud(self, track: int, keyframe: int) -> tuple[F8, NDArray[np.bool_]]:
        key = (track, keyframe)
        if key in self._clouds:
            self._clouds.move_to_end(key)
            return self._clouds[key]
        scan, label = self._shelves[track].read(int(self._tracks[track].scan_index[keyframe]))
        points = scan.points()
        fit = np.flatnonzero(
            (label.class_ < FIRST_LEFT_OUT)
            & (np.einsum("ni,ni->n", points, points) < self._settings.max_range_m**2)
        )
        fit = fit[downsample(points[fit], self._settings.voxel_size_m)]
        cloud = (points[fit].astype(float), label.class_[fit] == PointClass.GROUND)
        self._clouds[key] = cloud
        if len(self._clouds) > KEPT_CLOUDS:
            self._clouds.popitem(last=False)
        return cloud


def _levelled(points: F8, ground: NDArray[np.bool_], scan: F8) -> Submap:
    near = points[ground & (np.hypot(points[:, 0], points[:, 1]) < LEVEL_RADIUS_M)]
    if len(near) < 50:
        return Submap(points, ground, np.eye(4), float("nan"), scan)
    plane = _ground_plane(near)
    normal = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2)
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    R = np.column_stack((x, np.cross(normal, x), normal))
    return Submap(points @ R, ground, pose(R, np.zeros(3)), float(plane[2] * normal[2]), scan @ R)


def _ground_plane(points: F8) -> F8:
    """(a, b, c) of z = a x + b y + c, least squares with far residuals dropped twice."""
    A = np.column_stack((points[:, :2], np.ones(len(points))))
    keep = np.ones(len(points), bool)
    plane = np.zeros(3)
    for limit in (0.5, 0.2, 0.2):
        plane = np.linalg.lstsq(A[keep], points[keep, 2], rcond=None)[0]
        residual = np.abs(points[:, 2] - A @ plane)
        keep = residual < max(limit, float(np.median(residual)) * 2)
    return np.asarray(plane)
