"""Dust that wind and vehicles raise on the road, and the spray behind wheels in rain: soft clouds that drift and spread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.grains import DUST_INSTANCE, SPRAY_INSTANCE, Grains, Gusts, Rows, first_met
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
DUST_NEEDED, SPRAY_NEEDED = 3, 1
"""Grains for a return: dust so dense that a beam holds many of them sends rays back from a surface."""
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
class Plumes:
    """Soft clouds over time, with a texture of wisps."""

    seed: tuple[int, int]
    puffs: Callable[[float], list[Puff]]
    texture: Gusts
    needed: int
    strength: float
    """Median share of the light that comes back from it."""
    material: Material
    instance: int

    def met(self, index: int, t: float, origin: F8, direction: F8, reach_m: NDArray[np.float32]) -> Grains:
        """As `Air` has it. Of several puffs on a ray the first that sends it back hides the rest."""
        rng = np.random.default_rng((*self.seed, index))
        reach = reach_m.astype(np.float32).copy()
        hit = np.zeros(len(reach), bool)
        for puff in self.puffs(t):
            rows, range_m = self._through(rng, puff, t, origin, direction, reach)
            reach[rows], hit[rows] = range_m, True
        rows = np.flatnonzero(hit)
        strength = self.strength * np.exp(0.5 * rng.standard_normal(len(rows)))
        return Grains(rows, reach[rows].astype(float), strength, self.material, self.instance)

    def _through(
        self,
        rng: np.random.Generator,
        puff: Puff,
        t: float,
        origin: F8,
        direction: F8,
        reach: NDArray[np.float32],
    ) -> tuple[Rows, F8]:
        """Rays through one puff, whose extinction along a ray is a Gaussian about the nearest point."""
        from scipy.special import ndtr, ndtri

        scaled, heading = (puff.centre - origin) / puff.sigma_m, direction / puff.sigma_m
        steep = np.linalg.norm(heading, axis=1)
        middle = np.einsum("ni,ni->n", scaled, heading) / steep**2
        off2 = np.einsum("ni,ni->n", scaled, scaled) - (middle * steep) ** 2
        near = (off2 < 9.0) & (middle + 3 / steep > MIN_RANGE_M) & (middle - 3 / steep < reach)
        most = self.needed * puff.extinction * Gusts.MOST
        whole = most * np.exp(-off2 / 2) * np.sqrt(2 * np.pi) / steep
        start = ndtr((MIN_RANGE_M - middle) * steep)

        def range_at(depth: F8, rays: Rows) -> F8:
            share = start[rays] + depth / whole[rays]
            far = middle[rays] + ndtri(np.minimum(share, 1.0)) / steep[rays]
            out: F8 = np.where(share < 1, far, np.inf)
            return out

        def chance_at(range_m: F8, rays: Rows) -> F8:
            return self.texture(origin[rays] + direction[rays] * range_m[:, None], t) / Gusts.MOST

        return first_met(rng, np.flatnonzero(near), reach, range_at, chance_at, self.needed)


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
        Gusts.of(rng, wind, (0.7, 4.0), 0.7, 8),
        DUST_NEEDED,
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
        tracks = [mover.poses(path, times) for mover in wet]
        behind = [-mover.mesh.vertices[:, 0].max() for mover in wet]
        tracks.append(motion.poses(times))
        behind.append(-0.6)
        return [puff for T, x in zip(tracks, behind, strict=True) for puff in _wake(settings, T, x)]

    return Plumes(
        (settings.seed, 27),
        puffs,
        Gusts.of(rng, np.array([1.0, 0.5, 0.0]), (0.5, 2.5), 0.9, 8),
        SPRAY_NEEDED,
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
