"""What floats in the air and sends a ray back: flakes, dust, drops. Each ray meets the first of them, or none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.meshes import Material

DUST_INSTANCE, SNOW_INSTANCE, SPRAY_INSTANCE = 60_000, 60_001, 60_002
"""Numbers in the true points that tell what kind of thing in the air a point is."""

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Grains:
    """Rays (n,) that are sent back from the air: how far, m, how strongly (share of the light), and by what."""

    rows: Rows
    range_m: F8
    strength: F8
    material: Material
    instance: int


class Air(Protocol):
    """Something in the air."""

    def met(self, index: int, t: float, origin: F8, direction: F8, reach_m: NDArray[np.float32]) -> Grains:
        """Which rays (origin and direction (n, 3), free as far as `reach_m` (n,)) it sends back in a sweep.

        `index` is the sweep's number, `t` the time of its middle, s. The same for the same arguments.
        """


@dataclass(frozen=True)
class Gusts:
    """Uneven density, moved by the wind: exp of a sum of plane waves, with mean about 1 and at most `MOST`."""

    waves: F8
    """(k, 3) wave numbers, rad/m"""
    phase: F8
    wind_m_s: F8
    spread: float

    MOST = 4.0

    @classmethod
    def of(
        cls,
        rng: np.random.Generator,
        wind_m_s: F8,
        wavelength_m: tuple[float, float],
        spread: float,
        count: int = 6,
    ) -> Gusts:
        direction = rng.standard_normal((count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        number = 2 * np.pi / rng.uniform(*wavelength_m, (count, 1))
        return cls(direction * number, rng.uniform(0, 2 * np.pi, count), wind_m_s, spread)

    def __call__(self, p: F8, t: float) -> F8:
        """Density (n,) at places p (n, 3) at a time, relative to the mean."""
        angle = (p - self.wind_m_s * t) @ self.waves.T + self.phase
        swing = np.sqrt(2 / len(self.phase)) * np.cos(angle).sum(axis=1)
        out: F8 = np.minimum(np.exp(self.spread * swing - self.spread**2 / 2), self.MOST)
        return out


def first_met(
    rng: np.random.Generator,
    rows: Rows,
    reach_m: NDArray[np.float32],
    range_at: Callable[[F8, Rows], F8],
    chance_at: Callable[[F8, Rows], F8],
    needed: int = 1,
) -> tuple[Rows, F8]:
    """Where rays meet the grain that sends them back: rows and ranges (m,) m of those that do within their reach.

    Thinning of a Poisson process (Lewis and Shedler, Naval Research Logistics 26, 1979): `range_at(depth, rows)` turns an
    optical depth of the densest air into a range (inf beyond its end), `chance_at(range_m, rows)` is the share of that
    density that is there. With `needed` grains for a return the free path is less random, as in dense dust.
    """
    depth, count = np.zeros(len(rows)), np.zeros(len(rows), np.int64)
    found_rows, found_range = [rows[:0]], [depth[:0]]
    while len(rows):
        depth = depth + rng.exponential(1.0, len(rows))
        range_m = range_at(depth, rows)
        free = range_m < reach_m[rows]
        rows, depth, count, range_m = rows[free], depth[free], count[free], range_m[free]
        count = count + (rng.random(len(rows)) < chance_at(range_m, rows))
        done = count >= needed
        found_rows.append(rows[done])
        found_range.append(range_m[done])
        rows, depth, count = rows[~done], depth[~done], count[~done]
    return np.concatenate(found_rows), np.concatenate(found_range)
