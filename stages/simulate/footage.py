"""Images of the drive: what each camera sees of town, traffic and its own vehicle, row by row as it is read out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.simulate.cameras import model, true_mounts
from scanloom.stages.simulate.daylight import Daylight
from scanloom.stages.simulate.exposure import Film, develop, toned
from scanloom.stages.simulate.eye import B1, F4, I8, Eye, Met, meet, picture
from scanloom.stages.simulate.meshes import Material
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.paints import Paints
from scanloom.stages.simulate.rig import vehicle
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.sweeping import ground_material, scene_of
from scanloom.stages.simulate.town import Town
from scanloom.stages.simulate.traffic import Mover

_PLACES, _CONTRAST = ((0.0, 0.0), (0.3, -0.2), (-0.3, 0.2)), 0.6
_GREY = 0.2
"""Brightness that the exposure brings the image's mean to."""
_SLOW = 0.45
"""How much of the last exposure is kept."""
_FAR_M = 150.0
"""Farther things that move are not drawn."""
_GLOSSY = {
    Material.GLASS: 1.0,
    Material.PAINT_DARK: 0.7,
    Material.PAINT_LIGHT: 0.7,
    Material.METAL: 0.4,
    Material.WATER: 1.0,
}
"""How much of a mirror, of glass."""
_BALANCE = np.array([(1.02, 1.0, 0.97), (0.98, 1.0, 1.02), (1.0, 1.0, 0.98)], np.float32)
"""White balance of the cameras."""
_FIRST, _APART = 0.31, 0.07
"""When in their period the cameras begin, and how much later each next one is, as shares of it."""
_OWN = 65535
"""Number of the own vehicle."""
_LIFT_M = 0.02
"""So far before its surface a point does not shade itself."""


@dataclass(frozen=True)
class Shot:
    """One image as it is recorded."""

    camera: int
    stamp_ns: int
    """When its middle was exposed, on the camera's clock."""
    end_ns: int
    """When it was read out, on the recorder's clock."""
    jpeg: bytes


@dataclass
class _Seen:
    """What rays (n,) meet: points (n, 3) in the world and as their paint knows them."""

    range_m: F8
    points: F8
    normal: F8
    material: NDArray[np.uint8]
    tint: I8
    fixed: F8
    found: B1


class Footage:
    """All cameras of a drive."""

    def __init__(
        self, settings: Settings, town: Town, motion: Motion, movers: Sequence[Mover], paints: Paints
    ) -> None:
        self._settings, self._town, self._motion, self._movers = settings, town, motion, movers
        mesh, self._kind, self._instance = town.triangles()
        self._material = mesh.material
        self._scene = scene_of(mesh)
        self._bodies = [scene_of(mover.mesh) for mover in movers]
        self._reach_m = [float(np.linalg.norm(m.mesh.vertices, axis=1).max()) + 0.5 for m in movers]
        self._own, self._own_material = scene_of(vehicle()), vehicle().material
        self._light = Daylight(settings, self._scene)
        self._paints = paints
        self._mounts = true_mounts(settings)
        self._eyes = [Eye(model(settings, k)) for k in range(settings.cameras)]
        self._half_view = [
            float(np.arccos(np.clip(eye.directions(eye.pixels)[:, 2].min(), -1, 1))) for eye in self._eyes
        ]
        self._sees_own = [self._own_pixels(eye, T) for eye, T in zip(self._eyes, self._mounts)]

    def albedo(
        self, material: NDArray[np.uint8], instance: NDArray[np.uint16], own: B1, points: F8, times: F8
    ) -> NDArray[np.uint8]:
        """sRGB (n, 3) of what is at points (n, 3) of the world at times (n,) s, as an image in white light shows it."""
        fixed, tint = points.copy(), np.where(own, _OWN, instance).astype(np.int64)
        fixed[own] = _brought(inverse(self._motion.poses(times[own])), points[own])
        for number in np.unique(instance[instance > self._town.instances]).tolist():
            at = np.flatnonzero(instance == number)
            if number - self._town.instances <= len(self._movers):
                mover = self._movers[number - self._town.instances - 1]
                fixed[at] = _brought(inverse(mover.poses(self._town.path, times[at])), points[at])
        return toned(self._paints.albedo(material, tint, fixed))

    def lit(self, points: F8, directions: F8) -> B1:
        """Whether the sun shines on points (n, 3) seen along directions (n, 3); moving things cast no shadow."""
        return self._light.lit(points - _LIFT_M * directions)

    def shots(self) -> Iterator[Shot]:
        """Images in the order of their stamps."""
        s = self._settings
        exposures: list[float | None] = [None] * s.cameras
        for index in range(int(s.duration_s * s.camera_rate_hz)):
            for k in range(s.cameras):
                t = (index + _FIRST + _APART * k) / s.camera_rate_hz
                if t + s.readout_s / 2 >= s.duration_s:
                    continue
                radiance = self.radiance(k, t)
                exposures[k] = _adapted(exposures[k], radiance)
                rng = np.random.default_rng((s.seed, 32, index, k))
                yield self._shot(k, t, radiance * _BALANCE[k], exposures[k] or 1.0, rng)

    def radiance(self, camera: int, t: float) -> F4:
        """What reaches the lens (h, w, 3) at time t, s: the ground in the open sun sends its albedo."""
        s, eye, mounted = self._settings, self._eyes[camera], self._mounts[camera]
        rows = np.arange(eye.height) if s.readout_s > 0 else np.zeros(1, int)
        times = t + s.readout_s * (rows / max(eye.height - 1, 1) - 0.5) * (s.readout_s > 0)
        T_world_base = self._motion.poses(times)
        movers = self._in_view(camera, T_world_base[len(times) // 2] @ mounted, t)
        under_sky = np.zeros(eye.height * eye.width, bool)

        def look(directions: F8, pixels: I8) -> tuple[F4, I8]:
            row = pixels // eye.width if s.readout_s > 0 else np.zeros(len(pixels), int)
            seen, d = self._look(camera, directions, pixels, T_world_base, times, row, movers, mounted)
            if len(pixels) == len(under_sky):  # of finer looks it is taken from this first one
                at = np.flatnonzero(seen.found)
                under_sky[at] = self._light.under_sky(seen.points[at], seen.normal[at])
            return self._shaded(seen, d, directions, under_sky[pixels]), seen.material + 64 * seen.tint

        return picture(eye, look, _PLACES, _CONTRAST)

    def _in_view(self, camera: int, T_world_camera: F8, t: float) -> list[int]:
        """Numbers of movers that may be in the image."""
        forward, numbers = T_world_camera[:3, 2], []
        for number, mover in enumerate(self._movers):
            if not mover.present(np.array([t]))[0]:
                continue
            to_mover = mover.poses(self._town.path, np.array([t]))[0, :3, 3] - T_world_camera[:3, 3]
            away, reach = float(np.linalg.norm(to_mover)), self._reach_m[number]
            if away > _FAR_M:
                continue
            aside = np.arccos(np.clip(forward @ to_mover / max(away, 1e-3), -1.0, 1.0))
            if away < 2 * reach or aside < self._half_view[camera] + np.arcsin(reach / away):
                numbers.append(number)
        return numbers

    def _look(
        self, camera: int, directions: F8, pixels: I8, T_world_base: F8, times: F8, row: I8, movers: Sequence[int], mounted: F8
    ) -> tuple[_Seen, F8]:  # fmt: skip
        T = T_world_base @ mounted
        if len(T) == 1:
            d, origin = directions @ T[0, :3, :3].T, np.broadcast_to(T[0, :3, 3], directions.shape)
        else:
            d = np.einsum("nij,nj->ni", T[row, :3, :3], directions)
            origin = T[row, :3, 3]
        seen = self._town_seen(meet(self._scene, origin, d), origin, d)
        for number in movers:
            self._add_mover(seen, number, origin, d, times, row)
        self._add_own(seen, camera, directions, pixels, T_world_base, row, mounted)
        return seen, d

    def _town_seen(self, hit: Met, origin: F8, d: F8) -> _Seen:
        points = origin + d * np.where(hit.found, hit.range_m, 0.0)[:, None]
        material = self._material[hit.triangle].copy()
        ground = np.flatnonzero(
            (self._kind[hit.triangle] == PointClass.GROUND) & (material == Material.GRASS) & hit.found
        )
        material[ground] = ground_material(self._town, points[ground, :2])
        tint = self._instance[hit.triangle].astype(np.int64)
        return _Seen(
            hit.range_m.copy(), points, hit.normal.copy(), material, tint, points.copy(), hit.found.copy()
        )

    def _add_mover(self, seen: _Seen, number: int, origin: F8, d: F8, times: F8, row: I8) -> None:
        mover = self._movers[number]
        poses = mover.poses(self._town.path, times)
        to_mover = poses[len(poses) // 2, :3, 3] - origin[len(origin) // 2]
        reach = self._reach_m[number]
        along = d @ to_mover
        near = np.flatnonzero((along > -reach) & (to_mover @ to_mover - along**2 < reach**2))
        if len(near) == 0:
            return
        T = inverse(poses)[row[near]]
        o = np.einsum("nij,nj->ni", T[:, :3, :3], origin[near]) + T[:, :3, 3]
        local = np.einsum("nij,nj->ni", T[:, :3, :3], d[near])
        hit = meet(self._bodies[number], o, local)
        ahead = hit.found & (hit.range_m < seen.range_m[near])
        back = np.swapaxes(T[ahead, :3, :3], 1, 2)
        normal = np.einsum("nij,nj->ni", back, hit.normal[ahead])
        fixed = o[ahead] + local[ahead] * hit.range_m[ahead, None]
        material = mover.mesh.material[hit.triangle[ahead]]
        _put(seen, near[ahead], hit.range_m[ahead], origin, d, normal, material, fixed)
        seen.tint[near[ahead]] = self._town.instances + 1 + number

    def _add_own(
        self, seen: _Seen, camera: int, directions: F8, pixels: I8, T_world_base: F8, row: I8, mounted: F8
    ) -> None:
        at = np.flatnonzero(self._sees_own[camera][pixels])
        if len(at) == 0:
            return
        local = directions[at] @ mounted[:3, :3].T
        hit = meet(self._own, mounted[:3, 3], local)
        ahead = hit.found & (hit.range_m < seen.range_m[at])
        rows, R = at[ahead], T_world_base[row[at[ahead]], :3, :3]
        fixed = mounted[:3, 3] + local[ahead] * hit.range_m[ahead, None]
        origin = T_world_base[row, :3, 3] + T_world_base[row, :3, :3] @ mounted[:3, 3]
        d = np.zeros_like(directions)
        d[rows] = np.einsum("nij,nj->ni", R, local[ahead])
        normal = np.einsum("nij,nj->ni", R, hit.normal[ahead])
        material = self._own_material[hit.triangle[ahead]]
        _put(seen, rows, hit.range_m[ahead], origin, d, normal, material, fixed)
        seen.tint[rows] = _OWN

    def _shaded(self, seen: _Seen, d: F8, directions: F8, under_sky: B1) -> F4:
        """Paint in its light, mirrors of glass and paint, haze, and the sky where nothing is."""
        radiance = np.zeros((len(d), 3), np.float32)
        at = np.flatnonzero(seen.found)
        albedo = self._paints.albedo(seen.material[at], seen.tint[at], seen.fixed[at])
        light, lit = self._light.falling(seen.points[at], seen.normal[at], under_sky[at])
        colour = albedo * light
        for kind, gloss in _GLOSSY.items():
            shiny = np.flatnonzero(seen.material[at] == kind)
            if len(shiny):
                n, ray = seen.normal[at[shiny]], d[at[shiny]]
                colour[shiny] += self._mirrored(n, ray, lit[shiny], gloss)
        radiance[at] = self._light.hazed(colour, seen.range_m[at])
        sky = np.flatnonzero(~seen.found)
        radiance[sky] = self._light.sky(d[sky])
        radiance[~directions.any(axis=1)] = 0.0
        return radiance

    def _mirrored(self, normal: F8, ray: F8, lit: B1, gloss: float) -> F4:
        """Sky and sun in a shiny surface (Schlick 1994)."""
        facing = -np.einsum("ni,ni->n", normal, ray)
        share = gloss * (0.04 + 0.96 * (1.0 - np.clip(facing, 0.0, 1.0)) ** 5)
        back = ray + 2.0 * facing[:, None] * normal
        mirrored = self._light.sky(np.column_stack((back[:, :2], np.abs(back[:, 2]))))
        dark = (back[:, 2] < 0.0) | ~lit & (back @ self._light.towards_sun > 0.9)
        mirrored[dark] = 0.15
        return np.asarray(np.minimum(mirrored, 60.0) * share[:, None], np.float32)

    def _own_pixels(self, eye: Eye, mounted: F8) -> B1:
        """Pixels (h * w,) near the own vehicle in the image."""
        hit = meet(self._own, mounted[:3, 3], eye.directions(eye.pixels) @ mounted[:3, :3].T)
        own = hit.found.reshape(eye.height, eye.width)
        wide = own.copy()
        for axis in (0, 1):
            for step in (-1, 1):
                wide |= np.roll(own, step, axis)
        return wide.ravel()

    def _shot(self, camera: int, t: float, radiance: F4, exposure: float, rng: np.random.Generator) -> Shot:
        import cv2

        s = self._settings
        off = max(1.0 + s.exposure_noise * float(rng.standard_normal()), 0.2)
        image = develop(radiance, exposure * off, self._eyes[camera].model, Film(), rng)
        quality = [cv2.IMWRITE_JPEG_QUALITY, s.jpeg_quality]
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), quality)
        start = s.start_s * 1_000_000_000
        return Shot(
            camera,
            start + round((t + s.camera_clock_s) * 1e9),
            start + round((t + s.readout_s / 2) * 1e9),
            data.tobytes(),
        )


def _adapted(last: float | None, radiance: F4) -> float:
    """The exposure that follows the light, but not at once."""
    brightness = np.minimum(radiance.mean(axis=2), 2.0)
    wanted = _GREY / max(float(brightness.mean()), 1e-3)
    return wanted if last is None else float(last**_SLOW * wanted ** (1.0 - _SLOW))


def _brought(T: F8, points: F8) -> F8:
    """Points (n, 3), each by its own pose (n, 4, 4)."""
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3])


def _put(
    seen: _Seen, rows: I8, range_m: F8, origin: F8, d: F8, normal: F8, material: NDArray[np.uint8], fixed: F8
) -> None:
    seen.range_m[rows], seen.found[rows] = range_m, True
    seen.points[rows] = origin[rows] + d[rows] * range_m[:, None]
    seen.normal[rows], seen.material[rows], seen.fixed[rows] = normal, material, fixed
