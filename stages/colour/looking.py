"""Looking: which points of the map one image shows, and what it says of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera, CameraModel
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.trajectory import Poses
from scanloom.stages.colour.exposure import RINGS
from scanloom.stages.colour.light import sampled
from scanloom.stages.colour.seeing import through_boxes, visible
from scanloom.stages.colour.settings import Settings
from scanloom.stages.colour.surroundings import Cone, Ground, Surroundings
from scanloom.stages.colour.views import Views
from scanloom.stages.geometry.camera import rays
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8, inverse, pose, transform
from scanloom.stages.geometry.shutter import Sweep, as_met

FULL_WEIGHT_M = 8.0
"""Beyond this distance a view counts less, by its square."""
OTHER_TIME_NS = 250_000_000
"""Boxes of what moves are of scans; one so far from an image in time says nothing of it."""
CELLS_ACROSS, CELLS_DOWN = 32, 20
"""Of a picture, for what a camera always sees."""
_EDGE_STEPS = 65


@dataclass(frozen=True)
class Shot:
    """One image that can be thrown onto the map."""

    number: int
    camera: Camera
    camera_number: int
    pixels: NDArray[np.uint8]
    T_world_camera: F8
    """When its middle row was taken."""
    stamp_ns: int
    sweep: Sweep | None = None
    """Of a rolling shutter."""


class Looker:
    """Numbers the points of the map as it meets them, tile by tile."""

    def __init__(
        self, settings: Settings, poses: Poses, tracks: ObjectTracks, surroundings: Surroundings
    ) -> None:
        self._settings, self._poses, self._tracks = settings, poses, tracks
        self._surroundings = surroundings
        self.first: dict[str, int] = {}
        """Number of the first point of each tile."""
        self.voxel: dict[str, NDArray[np.int64]] = {}
        self._points = 0

    def look(self, shot: Shot) -> Views | None:
        """What the image says of the points that it shows; None where it shows none."""
        s, origin = self._settings, shot.T_world_camera[:3, 3]
        points, normal, number = self._before(shot)
        if not len(points):
            return None
        local = transform(inverse(shot.T_world_camera), points)
        if shot.sweep is not None:
            local = as_met(shot.camera.model, shot.sweep, local)
        turned = (normal @ shot.T_world_camera[:3, :3]).astype(np.float32)
        seen = visible(s, shot.camera.model, local, turned, self._surroundings.voxel_m)
        away = np.linalg.norm(local[seen.rows], axis=1)
        light, low, high = sampled(shot.pixels, seen.pixels)
        good = (away >= s.nearest_m) & (low >= s.darkest) & (high <= s.brightest)
        good &= ~through_boxes(origin, points[seen.rows], *self._boxes(shot.stamp_ns))
        if not good.any():
            return None
        weight = np.maximum(seen.cosine, 0.05) / np.maximum(away / FULL_WEIGHT_M, 1.0) ** 2
        count = int(good.sum())
        return Views(
            point=number[seen.rows[good]].astype(np.int32),
            image=np.full(count, shot.number, np.int32),
            camera=np.full(count, shot.camera_number, np.int32),
            cell=cells_of(shot, seen.pixels[good]),
            ring=rings_of(shot, seen.pixels[good]),
            away=away[good].astype(np.float32),
            light=np.log(np.maximum(light[good], 1e-5)).astype(np.float32),
            weight=weight[good].astype(np.float32),
            surely=seen.surely[good],
        )

    def _before(self, shot: Shot) -> tuple[F8, NDArray[np.float32], NDArray[np.int64]]:
        """Points (n, 3) that the image may show, their normals and numbers."""
        T, reach_m = shot.T_world_camera, self._settings.reach_m
        turned_rad = shot.sweep.turned_rad if shot.sweep is not None else 0.0
        cone = Cone(T[:3, 3], T[:3, 2], widest_cosine(shot.camera.model, turned_rad), reach_m)
        points, normal, number = [np.empty((0, 3))], [np.empty((0, 3), np.float32)], [np.empty(0, np.int64)]
        for name, ground in self._surroundings.near(cone.tip, reach_m):
            rows = ground.within(cone)
            points.append(ground.points[rows])
            normal.append(ground.normal[rows])
            number.append(self._number(name, ground) + rows)
        return np.concatenate(points), np.concatenate(normal), np.concatenate(number)

    def _number(self, name: str, ground: Ground) -> int:
        if name not in self.first:
            self.first[name], self.voxel[name] = self._points, ground.voxel
            self._points += len(ground.voxel)
        return self.first[name]

    def _boxes(self, stamp_ns: int) -> tuple[F8, F8]:
        """Poses (m, 4, 4) of the middles of boxes that move at a time, in the map's frame, and half their sizes (m, 3)."""
        tracks = self._tracks
        off_ns = np.abs(tracks.stamp_ns - stamp_ns)
        near = off_ns <= min(int(off_ns.min(initial=OTHER_TIME_NS)), OTHER_TIME_NS)
        rows = np.flatnonzero(near & tracks.dynamic)
        T = interpolate_poses(self._poses.stamp_ns, self._poses.T_world_lidar, tracks.stamp_ns[rows])
        size = np.column_stack((tracks.length_m, tracks.width_m, tracks.height_m))[rows]
        up = pose(np.tile(np.eye(3), (len(rows), 1, 1)), size * (0.0, 0.0, 0.5))
        grown = self._settings.moving_margin_m + tracks.speed_m_s[rows] * off_ns[rows] * 1e-9
        return T @ tracks.T_lidar_object[rows] @ up, 0.5 * size + grown[:, None]


def widest_cosine(model: CameraModel, turned_rad: float = 0.0) -> float:
    """Cosine of an angle from the camera's axis beyond which no pixel looks, were it turned by so much; half a degree to spare."""
    return float(np.cos(min(_widest_rad(model) + turned_rad + np.radians(0.5), np.pi)))


@lru_cache(maxsize=64)
def _widest_rad(model: CameraModel) -> float:
    """At the edge of the image; pi where the lens's formula does not reach it."""
    across = np.linspace(-0.5, model.width_px - 0.5, _EDGE_STEPS)
    down = np.linspace(-0.5, model.height_px - 0.5, _EDGE_STEPS)
    edge = [np.column_stack((across, np.full(_EDGE_STEPS, v))) for v in (down[0], down[-1])]
    edge += [np.column_stack((np.full(_EDGE_STEPS, u), down)) for u in (across[0], across[-1])]
    forward = rays(model, np.concatenate(edge))[:, 2]
    return float(np.arccos(forward.min())) if np.isfinite(forward).all() else np.pi


def cells_of(shot: Shot, pixels: F8) -> NDArray[np.int32]:
    """Cell of each pixel (n, 2), over all cameras."""
    model = shot.camera.model
    u = np.clip((pixels[:, 0] + 0.5) / model.width_px * CELLS_ACROSS, 0, CELLS_ACROSS - 1).astype(np.int32)
    v = np.clip((pixels[:, 1] + 0.5) / model.height_px * CELLS_DOWN, 0, CELLS_DOWN - 1).astype(np.int32)
    return np.asarray((shot.camera_number * CELLS_DOWN + v) * CELLS_ACROSS + u, np.int32)


def rings_of(shot: Shot, pixels: F8) -> NDArray[np.int32]:
    """Ring of each pixel (n, 2), by the square of its distance from the middle; the corners are in the last."""
    model = shot.camera.model
    middle = np.array([model.width_px - 1, model.height_px - 1]) / 2.0
    square = (((pixels - middle) / middle) ** 2).sum(axis=1) / 2.0
    return np.asarray(np.minimum(square * RINGS, RINGS - 1), np.int32)
