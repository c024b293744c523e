"""Colour: the images of one stretch thrown onto the map where the camera saw it, and what most of them say of each point.

The map's own points say what hides what. Images are brought to one exposure, lenses freed of their fall-off and cameras of their tint by the
points that several images show. Views that disagree with the others of their point (moving things, mirrors, edges, the own vehicle)
count little or nothing; what one image alone shows has to be seen beyond doubt. How bright a stretch is beside the others is left to `brightness`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scanloom.schemas.cameras import Camera, Cameras, Image, Images
from scanloom.schemas.errors import StageError
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.tiles import Paint, Piece
from scanloom.schemas.trajectory import Poses
from scanloom.stages.colour.exposure import equalised
from scanloom.stages.colour.light import LUMINANCE
from scanloom.stages.colour.looking import Looker, Shot
from scanloom.stages.colour.own import on_own_vehicle
from scanloom.stages.colour.settings import Settings
from scanloom.stages.colour.surroundings import Surroundings
from scanloom.stages.colour.views import F4, Gathered, Views, alone, off_consensus
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.pictures import decode
from scanloom.stages.geometry.se3 import F8, inverse, so3_log
from scanloom.stages.geometry.shutter import Sweep

VERSION = 4

__all__ = ["VERSION", "Settings", "colour"]

GREY = 0.18
"""Linear luminance that a stretch is brought to, so that whole numbers hold it well."""
TURNED_RAD = np.radians(5.0)
LEAST_AGREEMENT = 0.1
"""Of a view's weight; with less it is not counted as one."""


def colour(
    settings: Settings,
    images: Images,
    cameras: Cameras,
    poses: Poses,
    tracks: ObjectTracks,
    pieces: Parts[Piece],
) -> Iterator[Part[Paint]]:
    """Yield what the images add to each tile, ordered by tile; nothing where no camera is placed or nothing was seen.

    Memory holds every view: about 40 bytes for each point that each image shows.
    """
    placed = tuple(camera for camera in cameras.cameras if camera.T_lidar_camera is not None)
    looker = Looker(settings, poses, tracks, Surroundings(pieces, settings.tiles_held))
    gathered, count = Gathered(), 0
    for shot in _shots(settings, images, placed, poses):
        views = looker.look(shot)
        count = shot.number + 1
        if views is not None:
            gathered.add(views)
    if gathered:
        views = gathered.ordered()
        yield from _parts(looker, _blended(settings, views, count, len(placed)))


def _shots(settings: Settings, images: Images, cameras: tuple[Camera, ...], poses: Poses) -> Iterator[Shot]:
    """Images that can be thrown onto the map. One that cannot be decoded, was taken where the path is not known, or from where the camera
    took its last, adds nothing."""
    numbers = {camera.name: number for number, camera in enumerate(cameras)}
    last: dict[str, F8] = {}
    count = 0
    for image in images:
        T = _pose(image, cameras[numbers[image.camera]], poses) if image.camera in numbers else None
        if T is None or not _apart(settings, T, last.get(image.camera)):
            continue
        camera = cameras[numbers[image.camera]]
        try:
            pixels = decode(image)
        except StageError:
            continue
        if pixels.shape[:2] == (camera.model.height_px, camera.model.width_px):
            last[image.camera] = T
            yield Shot(
                count,
                camera,
                numbers[image.camera],
                pixels,
                T,
                image.stamp_ns,
                _sweep(image, camera, poses, T),
            )
            count += 1


def _pose(image: Image, camera: Camera, poses: Poses) -> F8 | None:
    """T_world_camera when it was taken; None where the path is not known."""
    at = np.array([image.stamp_ns], np.int64)
    if not inside(poses.stamp_ns, at)[0]:
        return None
    T = interpolate_poses(poses.stamp_ns, poses.T_world_lidar, at)[0] @ np.array(camera.T_lidar_camera)
    return T if np.isfinite(T).all() else None


def _sweep(image: Image, camera: Camera, poses: Poses, T_world_camera: F8) -> Sweep | None:
    """How the camera moved while the image was read; None for a global shutter."""
    if camera.readout_s == 0.0:
        return None
    half_ns = round(0.5e9 * camera.readout_s)
    ends = np.array([image.stamp_ns - half_ns, image.stamp_ns + half_ns], np.int64)
    first, last = interpolate_poses(poses.stamp_ns, poses.T_world_lidar, ends) @ np.array(
        camera.T_lidar_camera
    )
    return Sweep.between(first, T_world_camera, last)


def _apart(settings: Settings, T: F8, before: F8 | None) -> bool:
    """Whether a camera is elsewhere than before."""
    if before is None or settings.apart_m == 0.0:
        return True
    step = inverse(before) @ T
    turned = float(np.linalg.norm(so3_log(step[None, :3, :3])[0]))
    return bool(np.linalg.norm(step[:3, 3]) >= settings.apart_m or turned >= TURNED_RAD)


def _blended(settings: Settings, views: Views, images: int, cameras: int) -> tuple[Views, F8, F4]:
    """The views that count, what they show in the exposure and brightness of the stretch (n, 3), linear, and their
    weights (n,)."""
    light = equalised(views, images, cameras)
    if settings.own_share < 1.0:
        own = on_own_vehicle(views, off_consensus(views, light), cameras, settings.own_share)
        views, light = views.take(~own), light[~own]
    agreement = np.exp(-0.5 * (off_consensus(views, light) / settings.agree) ** 2)
    kept = agreement > LEAST_AGREEMENT
    views, weight, light = views.take(kept), (views.weight * agreement)[kept], light[kept]
    kept = views.surely | ~alone(views)
    views, weight, light = views.take(kept), weight[kept], light[kept]
    linear = np.exp(light.astype(np.float64))
    brightness = float(np.median(linear @ LUMINANCE)) if len(views) else 1.0
    return views, linear * (GREY / max(brightness, 1e-6)), weight


def _parts(looker: Looker, blended: tuple[Views, F8, F4]) -> Iterator[Part[Paint]]:
    """Sums over the views of each point, tile by tile."""
    views, linear, weight = blended
    for tile, first in sorted(looker.first.items()):
        voxel = looker.voxel[tile]
        rows = slice(*np.searchsorted(views.point, (first, first + len(voxel))))
        if rows.start == rows.stop:
            continue
        part, w = views.take(np.arange(rows.start, rows.stop)), weight[rows].astype(np.float64)
        starts = part.starts
        heavy = np.add.reduceat(w, starts[:-1])
        light = np.add.reduceat(w[:, None] * linear[rows], starts[:-1])
        yield Part(
            Paint(
                voxel=voxel[part.point[starts[:-1]] - first],
                weight=np.maximum(np.rint(heavy * Paint.WEIGHT_STEPS), 1).astype(np.int64),
                light=np.rint(light * Paint.LIGHT_STEPS).astype(np.int64),
                views=np.diff(starts).astype(np.int32),
            ),
            tile,
        )
