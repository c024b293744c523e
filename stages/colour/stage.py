"""Colour: the images of one stretch thrown onto the map, image by image, where the camera saw it.

The map's own points say what hides what. Images are brought to one exposure by the points that they share, and all of the stretch to one
brightness: an image cannot tell strong light from bright paint, so the world is taken to be middle grey on average.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.cameras import Camera, Cameras, Image, Images
from scanloom.schemas.errors import StageError
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.tiles import Paint, Piece
from scanloom.schemas.trajectory import Poses
from scanloom.stages.colour.light import LUMINANCE, gain, sampled
from scanloom.stages.colour.seeing import through_boxes, visible
from scanloom.stages.colour.surroundings import Ground, Surroundings
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.pictures import decode
from scanloom.stages.geometry.se3 import F8, inverse, pose, transform

VERSION = 1
LEAST_SHARED = 200
"""Points that two images need in common to be brought to one exposure."""
FULL_WEIGHT_M = 8.0
"""Beyond this distance a view counts less, by its square."""
OTHER_TIME_NS = 250_000_000
"""Boxes of what moves are of scans; one so far from an image in time says nothing of it."""


class Settings(BaseModel):
    """Which views colour a point, and how bright the map is."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach_m: float = Field(
        40.0, ge=1.0, le=200.0, description="points farther from the camera get no colour from it, m"
    )
    nearest_m: float = Field(2.0, ge=0.0, le=20.0, description="nor do points nearer than this, m")
    tolerance_m: float = Field(
        0.3, ge=0.01, le=5.0, description="a point so far behind what hides it is still seen, m"
    )
    margin_px: float = Field(
        3.0, ge=0.0, le=50.0, description="pixels beside the edge of something nearer that colour nothing, px"
    )
    darkest: int = Field(6, ge=0, le=255, description="darker pixels of 8 bits say nothing of colour")
    brightest: int = Field(250, ge=1, le=255, description="brighter pixels are taken to be saturated")
    grey: float = Field(
        0.18, gt=0.0, le=1.0, description="linear luminance that the points of a stretch are brought to"
    )
    moving_margin_m: float = Field(
        0.4, ge=0.0, le=5.0, description="boxes of moving objects grow by this to all sides, m"
    )
    tiles_held: int = Field(16, ge=1, le=1000, description="tiles that stay in memory, number")


def colour(
    settings: Settings,
    images: Images,
    cameras: Cameras,
    poses: Poses,
    tracks: ObjectTracks,
    pieces: Parts[Piece],
) -> Iterator[Part[Paint]]:
    """Yield what the images add to each tile, ordered by tile; nothing where no camera is placed or nothing was seen."""
    placed = {camera.name: camera for camera in cameras.cameras if camera.T_lidar_camera is not None}
    painter = Painter(settings, poses, tracks, Surroundings(pieces, settings.tiles_held))
    for image in images:
        if image.camera in placed:
            painter.add(placed[image.camera], image)
    yield from painter.parts()


@dataclass(frozen=True)
class _Seen:
    """Points of one tile that one image sees."""

    tile: str
    rows: NDArray[np.int64]
    light: F8
    weight: F8


class Painter:
    """Sums of light of the map's points, in the exposure of the first image."""

    def __init__(
        self, settings: Settings, poses: Poses, tracks: ObjectTracks, surroundings: Surroundings
    ) -> None:
        self._settings, self._poses, self._tracks = settings, poses, tracks
        self._surroundings = surroundings
        self._sums: dict[str, NDArray[np.float64]] = {}
        self._voxel: dict[str, NDArray[np.int64]] = {}

    def add(self, camera: Camera, image: Image) -> None:
        """Throw one image onto the map. One that cannot be decoded, or was taken where the path is not known, adds nothing."""
        at = np.array([image.stamp_ns], np.int64)
        if not inside(self._poses.stamp_ns, at)[0]:
            return
        try:
            pixels = decode(image)
        except StageError:
            return
        if pixels.shape[:2] != (camera.model.height_px, camera.model.width_px):
            return
        T_world_lidar = interpolate_poses(self._poses.stamp_ns, self._poses.T_world_lidar, at)[0]
        T_world_camera = T_world_lidar @ np.array(camera.T_lidar_camera)
        if np.isfinite(T_world_camera).all():
            self._blend(self._look(camera, pixels, T_world_camera, image.stamp_ns))

    def _look(
        self, camera: Camera, pixels: NDArray[np.uint8], T_world_camera: F8, stamp_ns: int
    ) -> list[_Seen]:
        s, origin = self._settings, T_world_camera[:3, 3]
        tiles = self._surroundings.near(origin, s.reach_m)
        points, normal, tile, row = _around(tiles, origin, s.reach_m)
        if not len(points):
            return []
        local = transform(inverse(T_world_camera), points)
        at, cosine, seen = visible(
            camera.model, local, (normal @ T_world_camera[:3, :3]).astype(np.float32),
            self._surroundings.voxel_m, s.margin_px, s.tolerance_m,
        )  # fmt: skip
        away = np.linalg.norm(local[seen], axis=1)
        light, low, high = sampled(pixels, at)
        good = (away >= s.nearest_m) & (low >= s.darkest) & (high <= s.brightest)
        good &= ~through_boxes(origin, points[seen], *self._boxes(stamp_ns))
        weight = np.maximum(cosine, 0.05) / np.maximum(away / FULL_WEIGHT_M, 1.0) ** 2
        seen, light, weight = seen[good], light[good], weight[good]
        found = []
        for number, (name, ground) in enumerate(tiles):
            mine = tile[seen] == number
            if mine.any():
                self._voxel.setdefault(name, ground.voxel)
                found.append(_Seen(name, row[seen[mine]], light[mine], weight[mine]))
        return found

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

    def _blend(self, found: list[_Seen]) -> None:
        """Add an image in the exposure of those before it."""
        if not found:
            return
        for seen in found:
            if seen.tile not in self._sums:
                self._sums[seen.tile] = np.zeros((len(self._voxel[seen.tile]), 5))
        before = np.concatenate([self._sums[seen.tile][seen.rows] for seen in found])
        light = np.concatenate([seen.light for seen in found])
        known = before[:, 0] > 0.0
        factor = gain(light[known], before[known, 1:4] / before[known, :1], LEAST_SHARED)
        if factor is None:
            factor = self._settings.grey / max(float(np.median(light @ LUMINANCE)), 1e-4)
        for seen in found:
            sums = self._sums[seen.tile]
            sums[seen.rows, 0] += seen.weight
            sums[seen.rows, 1:4] += seen.weight[:, None] * seen.light * factor
            sums[seen.rows, 4] += 1.0

    def parts(self) -> Iterator[Part[Paint]]:
        """Sums of each tile, all brought to one brightness."""
        scale = self._brightness()
        for tile, sums in sorted(self._sums.items()):
            rows = np.flatnonzero(sums[:, 4])
            yield Part(
                Paint(
                    voxel=self._voxel[tile][rows],
                    weight=np.maximum(np.rint(sums[rows, 0] * Paint.WEIGHT_STEPS), 1).astype(np.int64),
                    light=np.rint(sums[rows, 1:4] * scale * Paint.LIGHT_STEPS).astype(np.int64),
                    views=sums[rows, 4].astype(np.int32),
                ),
                tile,
            )

    def _brightness(self) -> float:
        """Factor that makes the median luminance of all points that were seen `grey`."""
        means = [
            (sums[sums[:, 4] > 0, 1:4] / sums[sums[:, 4] > 0, :1]) @ LUMINANCE
            for _, sums in sorted(self._sums.items())
        ]
        if not means:
            return 1.0
        return self._settings.grey / max(float(np.median(np.concatenate(means))), 1e-6)


def _around(
    tiles: list[tuple[str, Ground]], origin: F8, reach_m: float
) -> tuple[F8, NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Points (n, 3) within reach, their normals, the number of the tile each is from and its row there."""
    points, normal, tile, row = [np.empty((0, 3))], [np.empty((0, 3), np.float32)], [], []
    for number, (_, ground) in enumerate(tiles):
        rows = np.flatnonzero(((ground.points - origin) ** 2).sum(axis=1) < reach_m**2)
        points.append(ground.points[rows])
        normal.append(ground.normal[rows])
        tile.append(np.full(len(rows), number, np.int64))
        row.append(rows)
    none = [np.empty(0, np.int64)]
    return (
        np.concatenate(points),
        np.concatenate(normal),
        np.concatenate(tile + none),
        np.concatenate(row + none),
    )
