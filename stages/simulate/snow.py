"""Snowfall as a LiDAR sees it: near, weak, uneven, and other flakes in every sweep.

A flake of diameter D fills (D / w)^2 of a beam that is w wide there, and what comes back falls with 1 / r^2. So only large
flakes are seen from afar. The number of flakes in a metre of the beam grows with w^2; together this gives returns between
some metres and about 25 m. Sizes fall exponentially (Gunn and Marshall, Journal of Meteorology 15, 1958).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.grains import SNOW_INSTANCE, Grains, Gusts, Rows, first_met
from scanloom.stages.simulate.meshes import REFLECTIVITY, Material
from scanloom.stages.simulate.rig import MIN_RANGE_M, WEAKEST

WIDTH_M, DIVERGENCE_RAD = 0.010, 0.003
"""Width of a beam where it leaves the sensor, and its growth per metre."""
SIZES_M = np.linspace(0.0005, 0.016, 32)
MEAN_SIZE_M = 0.0022
NEEDED_POWER = 3 * WEAKEST
"""Of which half the flakes are seen: an echo as short and small as theirs is harder to tell from noise."""
OVERLAP_M = 1.5
"""Nearer than this, what comes back partly misses the receiver."""
EDGES_M = np.concatenate((np.arange(MIN_RANGE_M, 12, 0.1), np.arange(12, 45, 0.5)))
WIND_M_S = np.array([2.1, -1.2, -1.1])
TUNNEL_WIDE_M = 7.0
CLUMPS, CLUMP_RANGE_M, CLUMP_M = 0.1, 12.0, 0.03
"""Share of flakes that neighbouring beams meet, too, as far as this range, with this spread in range, m."""
NEIGHBOURS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
"""Firings and beams onwards."""


@dataclass(frozen=True)
class Snow:
    """Falling snow; `per_m` is the chance of a return per metre of ray where flakes are seen best."""

    seed: int
    per_m: float
    beams: int
    gusts: Gusts
    slow: Gusts
    tunnel_x: tuple[float, float]
    """No snow falls between, m east, in the road along y = 0."""
    depth: F8
    """Optical depth at EDGES_M for a `per_m` of 1."""
    sizes: F8
    """(edges, sizes) cumulative shares of the sizes of the flakes that are seen at a range."""

    @classmethod
    def of(cls, seed: int, per_m: float, beams: int, tunnel_x: tuple[float, float] = (0.0, 0.0)) -> Snow:
        rng = np.random.default_rng((seed, 23))
        seen = _seen()
        rate = seen.sum(axis=1) * _width(EDGES_M) ** 2 * (1 - np.exp(-((EDGES_M / OVERLAP_M) ** 2)))
        rate /= rate.max()
        depth = np.concatenate(([0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(EDGES_M))))
        sizes = np.cumsum(seen, axis=1)
        return cls(
            seed,
            per_m,
            beams,
            Gusts.of(rng, WIND_M_S, (3.0, 15.0), 0.6),
            Gusts.of(rng, 2 * WIND_M_S, (40.0, 120.0), 0.35, 4),
            tunnel_x,
            depth,
            sizes / sizes[:, -1:],
        )

    def met(self, index: int, t: float, origin: F8, direction: F8, reach_m: NDArray[np.float32]) -> Grains:
        """As `Air` has it."""
        rng = np.random.default_rng((self.seed, 22, index))
        if self.per_m == 0:
            return Grains(np.empty(0, np.int64), np.empty(0), np.empty(0), Material.SNOW, SNOW_INSTANCE)
        most = self.per_m * Gusts.MOST * float(self.slow(origin[:1], t)[0])
        rows, range_m = first_met(
            rng,
            np.arange(len(origin)),
            reach_m,
            lambda depth, _: np.interp(depth / most, self.depth, EDGES_M, right=np.inf),
            lambda r, rays: self._chance(origin[rays] + direction[rays] * r[:, None], t),
        )
        strength = self._strength(rng, range_m)
        rows, range_m, strength = self._clumped(rng, len(origin), rows, range_m, strength)
        return Grains(rows, range_m, strength, Material.SNOW, SNOW_INSTANCE)

    def _chance(self, p: F8, t: float) -> F8:
        inside = (
            (p[:, 0] > self.tunnel_x[0]) & (p[:, 0] < self.tunnel_x[1]) & (np.abs(p[:, 1]) < TUNNEL_WIDE_M)
        )
        out: F8 = np.where(inside, 0.0, self.gusts(p, t) / Gusts.MOST)
        return out

    def _strength(self, rng: np.random.Generator, range_m: F8) -> F8:
        """Of flakes that are seen, (n,)."""
        at = np.clip(np.searchsorted(EDGES_M, range_m), 0, len(EDGES_M) - 1)
        size = SIZES_M[(self.sizes[at] < rng.random((len(at), 1))).sum(axis=1)]
        turned = np.exp(0.35 * rng.standard_normal(len(at)))
        out: F8 = _share(size, range_m) * REFLECTIVITY[Material.SNOW] * turned
        return out

    def _clumped(
        self, rng: np.random.Generator, rays: int, rows: Rows, range_m: F8, strength: F8
    ) -> tuple[Rows, F8, F8]:
        """Some flakes stick together, or stand so near that one or two neighbouring beams meet them, too."""
        at = np.flatnonzero((rng.random(len(rows)) < CLUMPS) & (range_m < CLUMP_RANGE_M))
        at = np.concatenate((at, at[rng.random(len(at)) < 0.4]))
        step = NEIGHBOURS[rng.integers(len(NEIGHBOURS), size=len(at))]
        firing, beam = np.divmod(rows[at], self.beams)
        firing, beam = (firing + step[:, 0]) % (rays // self.beams), beam + step[:, 1]
        on = (beam >= 0) & (beam < self.beams)
        aside = np.maximum(range_m[at] + CLUMP_M * rng.standard_normal(len(at)), MIN_RANGE_M)
        weaker = strength[at] * rng.uniform(0.4, 1.0, len(at))
        new = (firing * self.beams + beam)[on]
        return (
            np.concatenate((rows, new)),
            np.concatenate((range_m, aside[on])),
            np.concatenate((strength, weaker[on])),
        )


def _width(range_m: F8) -> F8:
    return WIDTH_M + DIVERGENCE_RAD * range_m


def _share(size_m: F8, range_m: F8) -> F8:
    """Share of a beam's cross-section that a flake fills."""
    out: F8 = np.minimum((size_m / _width(range_m)) ** 2, 1.0)
    return out


def _seen() -> F8:
    """How many flakes of each size (edges, sizes) are seen of those in a unit of volume, at EDGES_M."""
    number = np.exp(-SIZES_M / MEAN_SIZE_M)
    strength = REFLECTIVITY[Material.SNOW] * _share(SIZES_M, EDGES_M[:, None])
    power = strength / np.maximum(EDGES_M[:, None], 1.0) ** 2
    out: F8 = number / (1 + (NEEDED_POWER / power) ** 2)
    return out
