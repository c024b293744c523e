"""The simulator's world, asked which points its cameras saw."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.colour_truth import Known
from scanloom.pipeline.run import Result
from scanloom.schemas.cameras import Camera, Cameras, Images
from scanloom.schemas.session import TruthLog
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8, inverse, transform
from scanloom.stages.simulate.daylight import Daylight
from scanloom.stages.simulate.eye import meet
from scanloom.stages.simulate.motion import build_motion
from scanloom.stages.simulate.rig import T_BASE, vehicle
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.sweeping import scene_of
from scanloom.stages.simulate.town import build_town
from scanloom.stages.simulate.traffic import build_traffic

B1 = NDArray[np.bool_]
BEHIND_M = 0.25
"""What is hit by so much nearer than a point hides it: points are noisy, and means of voxels."""
OFF_SURFACE_M = 0.1
"""A point is seen as well where its surface is seen so far in front of it."""
FAR_M = 60.0
BANDS = 10
"""Of a rolling shutter's image."""


@dataclass(frozen=True)
class Band:
    """Rows of an image, and where the LiDAR was when they were read."""

    camera: Camera
    stamp_ns: int
    T_world_lidar: F8
    first_row: float
    last_row: float


class World:
    """Town, traffic and own vehicle of one drive, and the cameras as they truly were."""

    def __init__(self, settings: Settings, result: Result) -> None:
        town = build_town(settings.town_seed, settings.parking_seed, settings.tunnel_m)
        motion = build_motion(settings, town.path)
        self._settings, self._path = settings, town.path
        self._movers = build_traffic(settings, town.path, motion)
        self._town = scene_of(town.triangles()[0])
        self._light = Daylight(settings, self._town)
        self._bodies = [scene_of(mover.mesh) for mover in self._movers]
        self._own = scene_of(vehicle())
        truth = result.parts(Truth)[0]
        self._truth = truth.stamp_ns, truth.T_truth_lidar
        folder = Path(next(path for _, path in result.files(TruthLog)))
        true = Cameras.model_validate_json((folder / "cameras.json").read_text())
        self._cameras = {camera.name: camera for camera in true.cameras}
        self._shots = [(image.camera, image.stamp_ns) for part in result.parts(Images) for image in part]

    def falling(self, points: Known) -> F8:
        """Light (n, 3) that falls on the points; level ground in the open sun gets 1."""
        above = points.place + OFF_SURFACE_M * points.normal
        light, _ = self._light.falling(above, points.normal, self._light.under_sky(above, points.normal))
        return light.astype(float)

    def seen(self, points: Known, reach_m: float) -> B1:
        """Which of the points any image shows from at most so far away."""
        seen = np.zeros(len(points.place), bool)
        for name, stamp_ns in self._shots:
            for band in self._bands(self._cameras[name], stamp_ns):
                rows = np.flatnonzero(~seen)
                seen[rows] = self._shown(band, points.place[rows], points.normal[rows], reach_m)
        return seen

    def _bands(self, camera: Camera, stamp_ns: int) -> Iterator[Band]:
        """Rows that are read at about one time; all of them by a global shutter."""
        count = BANDS if camera.readout_s > 0 else 1
        edges = np.linspace(0.0, camera.model.height_px, count + 1) - 0.5
        for first, last in pairwise(edges):
            share = (first + last) / 2 / max(camera.model.height_px - 1, 1) - 0.5
            at_ns = stamp_ns + round(1e9 * camera.readout_s * share)
            T_world_lidar = interpolate_poses(*self._truth, np.array([at_ns]))[0]
            yield Band(camera, at_ns, T_world_lidar, first, last)

    def _shown(self, band: Band, places: F8, normals: F8, reach_m: float) -> B1:
        T = band.T_world_lidar @ np.array(band.camera.T_lidar_camera)
        origin = T[:3, 3]
        shown = np.zeros(len(places), bool)
        near = np.flatnonzero(((places - origin) ** 2).sum(axis=1) < reach_m**2)
        pixels, inside = project(band.camera.model, transform(inverse(T), places[near]))
        near = near[inside & (pixels[:, 1] >= band.first_row) & (pixels[:, 1] < band.last_row)]
        facing = np.sign(np.einsum("ni,ni->n", normals[near], origin - places[near]))
        off = OFF_SURFACE_M * facing[:, None] * normals[near]
        for targets in (places[near], places[near] + off):
            left = ~shown[near]
            shown[near[left]] = self._free(origin, targets[left], band.T_world_lidar, band.stamp_ns)
        return shown

    def _free(self, origin: F8, targets: F8, T_world_lidar: F8, stamp_ns: int) -> B1:
        """Whether nothing stands or drives between."""
        free = _clear(self._town, origin, targets, np.eye(4))
        T_base = T_world_lidar @ inverse(T_BASE["lidar"])
        free[free] = _clear(self._own, origin, targets[free], T_base)
        t = stamp_ns * 1e-9 - self._settings.start_s
        for mover, body in zip(self._movers, self._bodies):
            if not mover.present(np.array([t]))[0]:
                continue
            T = mover.poses(self._path, np.array([t]))[0]
            if np.linalg.norm(T[:3, 3] - origin) < FAR_M:
                free[free] = _clear(body, origin, targets[free], T)
        return free


def _clear(scene: object, origin: F8, targets: F8, T_world_scene: F8) -> B1:
    """Whether a scene at a pose leaves the way from a place (3,) to targets (n, 3) clear."""
    if not len(targets):
        return np.zeros(0, bool)
    back = inverse(T_world_scene)
    start, ends = transform(back, origin[None])[0], transform(back, targets)
    away = np.linalg.norm(ends - start, axis=1)
    hit = meet(scene, start, (ends - start) / away[:, None])
    return np.asarray(hit.range_m > away - BEHIND_M)
