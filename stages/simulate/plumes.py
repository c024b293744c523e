"""Dust that wind and vehicles raise on the road, and the spray behind wheels in rain: soft clouds that drift and spread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.grains import DUST_INSTANCE, SPRAY_INSTANCE, Grains
from scanloom.stages.simulate.meshes import Material
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.rig import MIN_RANGE_M
from scanloom.stages.simulate.route import Path
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.traffic import Mover

BURST_S = 3.5
"""Mean time between two bursts of dust near the vehicle, s."""
LIFE_S = 9.0
FRESH_M, MIXING_M2_S = 0.6, 0.5
"""A puff is so wide when it is raised (standard deviation), and spreads by turbulence: var = FRESH^2 + 2 MIXING age."""
SETTLING_S = 6.0
STEP_M = 1.8
SHAPE = 50.0
DUST_LONE, SPRAY_LONE = 0.12, 0.6
CUT = 2.6
"""Standard deviations from its middle where a puff ends."""
STEP_R_M, FAR_M = 0.3, 45.0
RANGES_M = np.arange(STEP_R_M / 2, FAR_M, STEP_R_M)
"""Middles of the cells over which the optical depth of a ray is summed."""
THIN = 0.002
WISP_M, WISP_CELLS, WISP_SPREAD = 0.4, 40, 0.8
REACH_M = 60.0
"""Spray farther away is not seen."""
SPRAY_AGES_S = np.arange(0.1, 1.3, 0.15)
SPRAY_SPEED_M_S = 8.0
WHEELS_M = -1.6


@dataclass(frozen=True)
class Puff:
    """A soft ellipsoid: centre (3,), standard deviation (3,) m, extinction in its middle 1/m."""

    centre: F8
    sigma_m: F8
    extinction: float


@dataclass(frozen=True)
class Burst:
    """Dust raised along a stretch of road: when s and where (n, 3), how dense 1/m, how it drifts (3,) m/s."""

    born_s: F8
    place: F8
    extinction: F8
    drift_m_s: F8

    def puffs(self, t: float) -> list[Puff]:
        """Those in the air at a time; the wider, the thinner, and the dust settles."""
        age = t - self.born_s
        out = []
        for k in np.flatnonzero((age > 0.05) & (age < LIFE_S)):
            sigma = float(np.sqrt(FRESH_M**2 + 2 * MIXING_M2_S * age[k]))
            tall = min(0.55 * sigma, 1.3)
            centre = self.place[k] + self.drift_m_s * age[k] + np.array([0, 0, 0.2 + 0.8 * tall])
            thin = FRESH_M / sigma * np.exp(-age[k] / SETTLING_S)
            out.append(Puff(centre, np.array([sigma, sigma, tall]), float(self.extinction[k] * thin)))
        return out


@dataclass(frozen=True)
class Wisps:
    """Texture of a cloud: density relative to its mean, in cells of a block that repeats and drifts with the wind."""

    density: NDArray[np.float32]
    wind_m_s: F8

    @classmethod
    def of(cls, rng: np.random.Generator, wind_m_s: F8) -> Wisps:
        from scipy.ndimage import gaussian_filter

        white = rng.standard_normal((WISP_CELLS,) * 3)
        layers = [gaussian_filter(white, width, mode="wrap") for width in (1.2, 4.0)]
        noise = sum(layer / layer.std() for layer in layers) / np.sqrt(2)
        density = np.exp(WISP_SPREAD * noise)
        return cls((density / density.mean()).astype(np.float32), wind_m_s)

    def __call__(self, p: F8, t: float) -> NDArray[np.float32]:
        """Relative density (...) at places p (..., 3)."""
        x, y, z = np.moveaxis(((p - self.wind_m_s * t) / WISP_M).astype(np.int64) % WISP_CELLS, -1, 0)
        out: NDArray[np.float32] = self.density[x, y, z]
        return out


@dataclass(frozen=True)
class Plumes:
    """Soft clouds over time.

    A ray comes back from where its optical depth reaches a threshold with mean 1. Where a beam holds many grains the
    threshold hardly varies (Gamma with a large shape), and neighbouring rays see a surface; a share of rays, `lone`, is
    sent back by a single large grain (exponential), also from the thin fringe of a cloud.
    """

    seed: tuple[int, int]
    puffs: Callable[[float], list[Puff]]
    wisps: Wisps
    lone: float
    strength: float
    """Median share of the light that comes back from it."""
    material: Material
    instance: int

    def met(self, index: int, t: float, origin: F8, direction: F8, reach_m: NDArray[np.float32]) -> Grains:
        """As `Air` has it."""
        rng = np.random.default_rng((*self.seed, index))
        n = len(reach_m)
        lone = rng.random(n) < self.lone
        enough = np.where(lone, rng.exponential(1.0, n), rng.gamma(SHAPE, 1 / SHAPE, n))
        strength = self.strength * np.exp(0.5 * rng.standard_normal(n))
        rows, depth = self._depth(t, origin, direction)
        ends = depth[:, -1] >= enough[rows]
        rows, depth = rows[ends], depth[ends]
        cell = (depth < enough[rows, None]).sum(axis=1)
        before = np.where(cell > 0, depth[np.arange(len(rows)), cell - 1], 0.0)
        within = (enough[rows] - before) / (depth[np.arange(len(rows)), cell] - before)
        range_m = STEP_R_M * (cell + within)
        free = (range_m < reach_m[rows]) & (range_m > MIN_RANGE_M)
        return Grains(rows[free], range_m[free], strength[rows[free]], self.material, self.instance)

    def _depth(self, t: float, origin: F8, direction: F8) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Rays (m,) that come near a puff, and their optical depth (m, RANGES_M) as far as each of RANGES_M."""
        near = [(puff, _towards(puff, origin, direction)) for puff in self.puffs(t)]
        touched = np.zeros(len(origin), bool)
        for _, towards in near:
            touched[towards] = True
        rows = np.flatnonzero(touched)
        density = np.zeros((len(rows), len(RANGES_M)), np.float32)
        for puff, towards in near:
            _add(density, np.searchsorted(rows, towards), puff, origin[towards], direction[towards])
        ray, cell = np.nonzero(density > THIN)
        place = origin[rows[ray]] + direction[rows[ray]] * RANGES_M[cell, None]
        density[ray, cell] *= self.wisps(place, t)
        return rows, np.cumsum(density * np.float32(STEP_R_M), axis=1)


def _add(density: NDArray[np.float32], at: NDArray[np.int64], puff: Puff, origin: F8, direction: F8) -> None:
    """Add the extinction of a puff in the middles of the cells of rays: a Gaussian about each ray's nearest point."""
    scaled, heading = (puff.centre - origin) / puff.sigma_m, direction / puff.sigma_m
    steep2 = np.einsum("ni,ni->n", heading, heading)
    middle = np.einsum("ni,ni->n", scaled, heading) / steep2
    off2 = np.einsum("ni,ni->n", scaled, scaled) - middle**2 * steep2
    half = np.sqrt(np.maximum(CUT**2 - off2, 0.0) / steep2)
    through = np.flatnonzero((half > 0) & (middle + half > 0))
    if len(through) == 0:
        return
    first, last = np.searchsorted(RANGES_M, [(middle - half)[through].min(), (middle + half)[through].max()])
    off = (RANGES_M[first:last] - middle[through, None]).astype(np.float32)
    fall = off2[through, None].astype(np.float32) + off**2 * steep2[through, None].astype(np.float32)
    density[at[through], first:last] += np.float32(puff.extinction) * np.exp(np.float32(-0.5) * fall)


def _towards(puff: Puff, origin: F8, direction: F8) -> NDArray[np.int64]:
    """Rays that may meet a puff: those into the cone about a ball round it, with room for the way the sensor moves."""
    there = puff.centre - origin[len(origin) // 2]
    radius = CUT * float(puff.sigma_m.max()) + 1.5
    far2 = float(there @ there)
    if far2 <= radius**2:
        return np.arange(len(origin))
    return np.flatnonzero(direction @ there > np.sqrt(far2 - radius**2))


def dust_clouds(settings: Settings, path: Path, motion: Motion) -> Plumes:
    """Bursts near where the vehicle will be: half raised by gusts at once, half by wheels along a lane."""
    rng = np.random.default_rng((settings.seed, 24))
    speed, bearing = rng.uniform(1.5, 4.0), rng.uniform(0, 2 * np.pi)
    wind = speed * np.array([np.cos(bearing), np.sin(bearing), 0.02])
    count = int((settings.duration_s + LIFE_S) / BURST_S) + 1
    bursts = []
    for start in np.sort(rng.uniform(-LIFE_S, settings.duration_s, count)):
        passed = start + rng.uniform(1.0, 7.0)
        centre = float(motion.arc(np.clip(passed, -5.0, settings.duration_s + 5.0))) + rng.uniform(-8, 25)
        bursts.append(_burst(settings, rng, path, float(start), centre, wind))
    return Plumes(
        (settings.seed, 25),
        lambda t: [puff for burst in bursts for puff in burst.puffs(t)],
        Wisps.of(rng, wind),
        DUST_LONE,
        0.05,
        Material.DUST,
        DUST_INSTANCE,
    )


def _burst(
    settings: Settings, rng: np.random.Generator, path: Path, start_s: float, centre_m: float, wind: F8
) -> Burst:
    long = rng.uniform(6.0, 22.0)
    s: F8 = centre_m + np.arange(-long / 2, long / 2, STEP_M)
    by_wheels = rng.random() < 0.5
    left = rng.choice([0.0, 3.5]) if by_wheels else rng.uniform(-5.0, 9.0)
    delay = np.asarray(np.arange(len(s)) * STEP_M / 7.0 if by_wheels else rng.uniform(0, 1.5, len(s)), float)
    heading = path.heading(s)
    aside = (left + rng.normal(0, 0.4, len(s)))[:, None]
    place = path.at(s) + aside * np.column_stack((-np.sin(heading), np.cos(heading), np.zeros(len(s))))
    extinction = settings.dust_clouds * rng.uniform(0.5, 1.5, len(s))
    return Burst(start_s + delay, place, extinction, wind * rng.uniform(0.8, 1.2))


def spray(settings: Settings, path: Path, motion: Motion, movers: Sequence[Mover]) -> Plumes:
    """Water behind the wheels of everybody on four of them, and behind the own ones; more of it at speed."""
    rng = np.random.default_rng((settings.seed, 26))
    wet = [mover for mover in movers if mover.what in ("car", "truck", "bus")]

    def puffs(t: float) -> list[Puff]:
        times = t - SPRAY_AGES_S
        here = motion.poses(times)
        found = _wake(settings, here, -0.6)
        for mover in wet:
            if np.linalg.norm(mover.poses(path, times[:1])[0, :3, 3] - here[0, :3, 3]) < REACH_M:
                found += _wake(settings, mover.poses(path, times), -float(mover.mesh.vertices[:, 0].max()))
        return found

    return Plumes(
        (settings.seed, 27),
        puffs,
        Wisps.of(rng, np.array([1.0, 0.5, 0.0])),
        SPRAY_LONE,
        0.035,
        Material.WATER,
        SPRAY_INSTANCE,
    )


def _wake(settings: Settings, T: F8, behind_m: float) -> list[Puff]:
    """Spray that a vehicle, with poses (n, 4, 4) at SPRAY_AGES_S ago, has left in the air."""
    p, ages = T[:, :3, 3] + behind_m * T[:, :3, 0], SPRAY_AGES_S
    speed = np.linalg.norm(p[0] - p[-1]) / (ages[-1] - ages[0])
    if speed < 1.5:
        return []
    fresh = settings.spray_per_m * min((speed / SPRAY_SPEED_M_S) ** 2, 2.0)
    return [
        Puff(
            place + np.array([0, 0, 0.35 + 0.3 * age]),
            np.array([0.5 + 0.4 * age, 0.5 + 0.4 * age, 0.25 + 0.3 * age]),
            float(fresh * np.exp(-age / 0.6)),
        )
        for place, age in zip(p, ages, strict=True)
    ]
