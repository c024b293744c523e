"""A spinning LiDAR that moves while it turns: rays, what they meet, and what of it the sensor reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.simulate.grains import DUST_INSTANCE, Air, Grains
from scanloom.stages.simulate.meshes import REFLECTIVITY, Material, Mesh
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.rig import MIN_RANGE_M, T_BASE, WEAKEST, vehicle
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.terrain import RASTER_M, SOUTH, WEST
from scanloom.stages.simulate.town import Town
from scanloom.stages.simulate.traffic import Mover, Puff, dust

BATCH_RAYS = 262_144
RESOLUTION_M = 0.002


@dataclass(frozen=True)
class Sweep:
    """What the sensor reports of one turn, and what each return truly is. Points without return are left out."""

    index: int
    start_ns: int
    xyz: NDArray[np.float32]
    """(n, 3) m in the LiDAR frame at each point's own time."""
    intensity: NDArray[np.float32]
    ring: NDArray[np.uint16]
    time_s: NDArray[np.float32]
    """(n,) seconds after the start of the sweep."""
    kind: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    material: NDArray[np.uint8]
    albedo: NDArray[np.uint8] | None = None
    """(n, 3) red, green, blue as sRGB, where there are cameras."""
    lit: NDArray[np.bool_] | None = None
    """(n,) whether the sun shines there."""


class Colours(Protocol):
    """What colour points have."""

    def albedo(
        self,
        material: NDArray[np.uint8],
        instance: NDArray[np.uint16],
        own: NDArray[np.bool_],
        points: F8,
        times: F8,
    ) -> NDArray[np.uint8]:
        """sRGB (n, 3) of points (n, 3) of the world at times (n,) s; `own` are those of the own vehicle."""

    def lit(self, points: F8, directions: F8) -> NDArray[np.bool_]:
        """Whether the sun shines on points (n, 3) seen along directions (n, 3)."""


@dataclass
class _Echo:
    """The nearest thing each ray meets: range m, cosine of incidence, material, class, instance, and the strength of
    what the air sent back (NaN where a surface did)."""

    range_m: NDArray[np.float32]
    cosine: NDArray[np.float32]
    material: NDArray[np.uint8]
    kind: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    airborne: NDArray[np.float32]


class Lidar:
    """The sensor in its town."""

    def __init__(
        self,
        settings: Settings,
        town: Town,
        motion: Motion,
        actors: Sequence[Mover],
        weather: Sequence[Air] = (),
        colours: Colours | None = None,
    ) -> None:
        self._colours = colours
        self._settings, self._town, self._motion, self._actors = settings, town, motion, actors
        self._weather = weather
        mesh, self._kind, self._instance = town.triangles()
        self._material = mesh.material
        self._scene = scene_of(mesh)
        self._bodies = [(scene_of(actor.mesh), actor.mesh.material) for actor in actors]
        self._own, self._own_material = scene_of(vehicle()), vehicle().material
        elevation = np.radians(np.linspace(settings.low_deg, settings.high_deg, settings.beams))
        azimuth = np.pi - 2 * np.pi * np.arange(settings.columns) / settings.columns
        self._rays = _rays(azimuth, elevation)
        # No laser points exactly where its data sheet says, nor measures from exactly the same zero.
        rng = np.random.default_rng((settings.seed, 20))
        skew = np.radians(settings.beam_angle_error_deg) * rng.standard_normal((2, settings.beams))
        self._true_rays = _rays(azimuth[:, None] + skew[0], elevation + skew[1])
        self._offset = np.tile(
            settings.beam_range_error_m * rng.standard_normal(settings.beams), settings.columns
        )
        self._ring = np.tile(np.arange(settings.beams, dtype=np.uint16), settings.columns)
        self._column = np.repeat(np.arange(settings.columns), settings.beams)
        self._own_echo = self._see_own_vehicle()

    def sweeps(self) -> Iterator[Sweep]:
        """All sweeps of the log in order; several are cast at once, which changes nothing but the time it takes."""
        s = self._settings
        count = round(s.duration_s * s.rate_hz)
        batch = max(1, BATCH_RAYS // len(self._rays))
        for first in range(0, count, batch):
            indices = range(first, min(first + batch, count))
            starts = np.array([index / s.rate_hz for index in indices])
            times = starts[:, None] + np.arange(s.columns) / (s.columns * s.rate_hz)
            T = self._motion.poses(times.ravel()) @ T_BASE["lidar"]
            T = T.reshape(len(indices), s.columns, 4, 4)
            origin = np.repeat(T[..., :3, 3], s.beams, axis=1)
            rays = self._true_rays.reshape(s.columns, s.beams, 3)
            direction = (rays @ np.swapaxes(T[..., :3, :3], -1, -2)).reshape(len(indices), -1, 3)
            echoes = self._cast_town(origin, direction)
            for k, index in enumerate(indices):
                yield self._sweep(index, float(starts[k]), times[k], origin[k], direction[k], echoes, k)

    def _cast_town(self, origin: F8, direction: F8) -> dict[str, NDArray[Any]]:
        shape = direction.shape[:2]
        rays = np.concatenate((origin, direction), axis=-1).astype(np.float32).reshape(-1, 6)
        hit = cast(self._scene, rays)
        return {name: value.reshape(*shape, *value.shape[1:]) for name, value in hit.items()}

    def _sweep(
        self, index: int, start_s: float, times: F8, origin: F8, direction: F8, echoes: dict[str, Any], k: int
    ) -> Sweep:
        rng = np.random.default_rng((self._settings.seed, 21, index))
        echo = self._town_echo({name: value[k] for name, value in echoes.items()}, origin, direction)
        self._add_own_vehicle(echo)
        self._add_actors(echo, times, origin, direction)
        for puff in dust(self._settings, self._town.path, self._actors, float(times[len(times) // 2])):
            _add_dust(echo, puff, origin, direction, rng)
        for air in self._weather:
            t = float(times[len(times) // 2])
            _add_grains(echo, air.met(index, t, origin, direction, echo.range_m))
        sweep, rows = self._report(index, start_s, times, echo, rng)
        if self._colours is None:
            return sweep
        points = origin[rows] + direction[rows] * echo.range_m[rows, None]
        column = times[self._column[rows]]
        material, instance = echo.material[rows], echo.instance[rows]
        own = echo.kind[rows] == PointClass.EGO
        albedo = self._colours.albedo(material, instance, own, points, column)
        return replace(sweep, albedo=albedo, lit=self._colours.lit(points, direction[rows]))

    def _town_echo(self, hit: dict[str, Any], origin: F8, direction: F8) -> _Echo:
        found = np.isfinite(hit["range"])
        triangle = np.where(found, hit["triangle"], 0).astype(np.int64)
        material = self._material[triangle]
        kind = np.where(found, self._kind[triangle], 0).astype(np.uint8)
        self._paint_ground(material, kind, origin, direction, hit["range"])
        surface = np.full(len(kind), np.nan, np.float32)
        return _Echo(
            hit["range"].copy(), hit["cosine"], material, kind, self._instance[triangle].copy(), surface
        )

    def _paint_ground(
        self,
        material: NDArray[np.uint8],
        kind: NDArray[np.uint8],
        origin: F8,
        direction: F8,
        range_m: NDArray[Any],
    ) -> None:
        """What the ground is made of stands in a raster, finer than its triangles."""
        rows = np.flatnonzero((kind == PointClass.GROUND) & (material == Material.GRASS))
        p = origin[rows, :2] + direction[rows, :2] * range_m[rows, None]
        material[rows] = ground_material(self._town, p)

    def _see_own_vehicle(self) -> tuple[NDArray[np.int64], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Own roof and bonnet, the same in every sweep: rays, ranges, cosines, materials."""
        T = T_BASE["lidar"]
        rays = np.column_stack((np.broadcast_to(T[:3, 3], self._rays.shape), self._true_rays @ T[:3, :3].T))
        hit = cast(self._own, rays.astype(np.float32))
        rows = np.flatnonzero(np.isfinite(hit["range"]))
        return (
            rows,
            hit["range"][rows],
            hit["cosine"][rows],
            self._own_material[hit["triangle"][rows].astype(int)],
        )

    def _add_own_vehicle(self, echo: _Echo) -> None:
        rows, range_m, cosine, material = self._own_echo
        _replace(echo, rows, range_m, cosine, material, PointClass.EGO, 0)

    def _add_actors(self, echo: _Echo, times: F8, origin: F8, direction: F8) -> None:
        middle = times[[len(times) // 2]]
        centre_ray = origin[len(origin) // 2]
        for number, (actor, (scene, material)) in enumerate(zip(self._actors, self._bodies), start=1):
            if not actor.present(middle)[0]:
                continue
            to_actor = actor.poses(self._town.path, middle)[0, :3, 3] - centre_ray
            reach = float(np.linalg.norm(actor.mesh.vertices, axis=1).max()) + 2.5
            if np.linalg.norm(to_actor) > self._settings.max_range_m + reach:
                continue
            along = direction @ to_actor
            near = (along > -reach) & (to_actor @ to_actor - along**2 < reach**2)
            rows = np.flatnonzero(near)
            if len(rows) == 0:
                continue
            columns, inverse_of = np.unique(self._column[rows], return_inverse=True)
            T = inverse(actor.poses(self._town.path, times[columns]))[inverse_of]
            o = (T[:, :3, :3] @ origin[rows, :, None])[..., 0] + T[:, :3, 3]
            d = (T[:, :3, :3] @ direction[rows, :, None])[..., 0]
            hit = cast(scene, np.concatenate((o, d), axis=1).astype(np.float32))
            seen = np.flatnonzero(np.isfinite(hit["range"]))
            made_of = material[hit["triangle"][seen].astype(int)]
            instance = self._town.instances + number
            _replace(
                echo,
                rows[seen],
                hit["range"][seen],
                hit["cosine"][seen],
                made_of,
                actor.kind(float(middle[0])),
                instance,
            )

    def _report(
        self, index: int, start_s: float, times: F8, echo: _Echo, rng: np.random.Generator
    ) -> tuple[Sweep, NDArray[np.int64]]:
        """Noise, strength, losses: what is left of an echo when it leaves the sensor, and the rays it is from."""
        s = self._settings
        n = len(echo.range_m)
        noise, chance, shade = rng.standard_normal(n), rng.random((3, n)), rng.standard_normal(n)
        measured = echo.range_m.astype(float) + self._offset + s.range_noise_m * noise
        stray = chance[0] < s.outliers
        measured[stray] = MIN_RANGE_M + (s.max_range_m - MIN_RANGE_M) * chance[1, stray]
        measured = np.round(measured / RESOLUTION_M) * RESOLUTION_M
        surface = REFLECTIVITY[echo.material] * np.maximum(echo.cosine, 0.02)
        in_air = ~np.isnan(echo.airborne)
        strength = np.where(in_air, echo.airborne, surface)
        # Of what is in the air only what is seen was met.
        power = np.where(in_air, np.inf, strength / np.maximum(echo.range_m, 1.0) ** 2)
        lost = chance[2] < s.dropout + (1 - s.dropout) * WEAKEST / (WEAKEST + power)
        kept = np.isfinite(echo.range_m) & ~lost & (measured > MIN_RANGE_M) & (measured < s.max_range_m)
        rows = np.flatnonzero(kept)
        kind = np.where(stray, PointClass.OUTLIER, echo.kind).astype(np.uint8)
        intensity = np.clip(100 * strength * (1 + 0.08 * shade), 0, 255)
        time_s = times[self._column[rows]] - start_s
        sweep = Sweep(
            index=index,
            start_ns=s.start_s * 1_000_000_000 + round(start_s * 1e9),
            xyz=(self._rays[rows] * measured[rows, None]).astype(np.float32),
            intensity=np.round(intensity[rows], 1).astype(np.float32),
            ring=self._ring[rows],
            time_s=time_s.astype(np.float32),
            kind=kind[rows],
            instance=echo.instance[rows],
            material=echo.material[rows],
        )
        return sweep, rows


def _rays(azimuth: F8, elevation: F8) -> F8:
    """Unit directions (columns * beams, 3), column by column; azimuths (columns,) or (columns, beams) rad."""
    a, e = np.broadcast_arrays(azimuth if azimuth.ndim == 2 else azimuth[:, None], elevation)
    return np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=-1).reshape(-1, 3)


def ground_material(town: Town, xy: F8) -> NDArray[np.uint8]:
    """What the ground is made of at places (n, 2)."""
    raster = town.terrain.material
    i = np.clip(((xy[:, 1] - SOUTH) / RASTER_M).astype(int), 0, raster.shape[0] - 1)
    j = np.clip(((xy[:, 0] - WEST) / RASTER_M).astype(int), 0, raster.shape[1] - 1)
    return np.asarray(raster[i, j])


def scene_of(mesh: Mesh) -> Any:
    """A scene that rays can be cast into."""
    import open3d as o3d

    tensor: Any = o3d.core.Tensor  # its stubs know nothing of numpy
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32)))
    return scene


def cast(scene: Any, rays: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    """Range (n,) m (inf where nothing is met), triangle (n,), cosine of incidence (n,) of rays (n, 6)."""
    import open3d as o3d

    tensor: Any = o3d.core.Tensor
    hit = scene.cast_rays(tensor(np.ascontiguousarray(rays)))
    normal = hit["primitive_normals"].numpy()
    return {
        "range": hit["t_hit"].numpy(),
        "triangle": hit["primitive_ids"].numpy(),
        "cosine": np.abs(np.einsum("ni,ni->n", normal, rays[:, 3:])),
    }


def _replace(
    echo: _Echo, rows: NDArray[Any], range_m: NDArray[Any], cosine: NDArray[Any], material: NDArray[Any],
    kind: PointClass, instance: int,
) -> None:  # fmt: skip
    """Where the new echo is nearer, it hides the old one."""
    nearer = range_m < echo.range_m[rows]
    at = rows[nearer]
    echo.range_m[at], echo.cosine[at], echo.material[at] = range_m[nearer], cosine[nearer], material[nearer]
    echo.kind[at], echo.instance[at] = kind, instance


def _add_grains(echo: _Echo, grains: Grains) -> None:
    """Where a grain is nearer than what the ray met, it hides that; of two grains on one ray the nearer is seen."""
    near_last = np.argsort(-grains.range_m, kind="stable")
    rows, range_m = grains.rows[near_last], grains.range_m[near_last].astype(np.float32)
    nearer = range_m < echo.range_m[rows]
    at = rows[nearer]
    echo.range_m[at], echo.airborne[at] = range_m[nearer], grains.strength[near_last][nearer]
    echo.cosine[at], echo.material[at] = 1.0, grains.material
    echo.kind[at], echo.instance[at] = PointClass.AIRBORNE, grains.instance


def _add_dust(echo: _Echo, puff: Puff, origin: F8, direction: F8, rng: np.random.Generator) -> None:
    """Rays that meet a grain within the ball: free path exponential with the extinction (Beer and Lambert)."""
    to_centre = puff.centre - origin
    along = np.einsum("ni,ni->n", direction, to_centre)
    gap2 = np.einsum("ni,ni->n", to_centre, to_centre) - along**2
    rows = np.flatnonzero((gap2 < puff.radius_m**2) & (along > 0))
    half = np.sqrt(puff.radius_m**2 - gap2[rows])
    free = rng.exponential(1 / puff.extinction, len(rows))
    range_m = np.maximum(along[rows] - half, MIN_RANGE_M) + free
    met = free < 2 * half
    shape = np.full(int(met.sum()), 0.5, np.float32)
    dusty = np.full(int(met.sum()), Material.DUST, np.uint8)
    _replace(echo, rows[met], range_m[met], shape, dusty, PointClass.AIRBORNE, DUST_INSTANCE)
