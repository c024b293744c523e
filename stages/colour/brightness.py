"""Brightness: all stretches of a session brought to one, and the session to middle grey; one row per voxel then.

Each stretch comes in a brightness of its own. Where two saw the same voxels they tell how much brighter one is; all of them together by least
squares. What is left is one factor for the session: images cannot tell strong light from bright paint, so the world is
taken to be middle grey on average.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.product import Part, Parts
from scanloom.schemas.tiles import Colours, Paint
from scanloom.stages.colour.light import LUMINANCE
from scanloom.stages.geometry.se3 import F8

VERSION = 1

PRIOR = 1e-3
"""Of a shared voxel: what ties a stretch to the others that shares none with them."""
MOST_SHARED = 2000
"""Shared voxels of one tile that count; their errors are alike."""
BINS, LOWEST, HIGHEST = 1200, -8.0, 4.0
"""Of logarithms of luminance."""


class Settings(BaseModel):
    """How bright the map is."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    grey: float = Field(
        0.18,
        gt=0.0,
        le=1.0,
        description="linear luminance that the points of a session are brought to, median",
    )
    least_shared: int = Field(
        50, ge=1, le=100000, description="voxels of a tile that two stretches must share to be compared there"
    )


def brightness(settings: Settings, paints: Parts[Paint]) -> Iterator[Part[Colours]]:
    """Yield the colours of each tile that any image saw, ordered by tile. Tiles are read one by one, twice."""
    if not len(paints):
        return
    stretches = sorted({where["footage"] for where in paints.coordinates()})
    number = {name: k for k, name in enumerate(stretches)}
    survey = _Survey(len(stretches), settings.least_shared)
    for parts in paints.by("tile").values():
        survey.add([(number[where["footage"]], paint) for where, paint in parts.items()])
    factors = survey.factors(settings.grey)
    for tile, parts in paints.by("tile").items():
        yield Part(
            merged([(factors[number[where["footage"]]], paint) for where, paint in parts.items()]), tile
        )


class _Survey:
    """How bright the stretches are, and how they compare."""

    def __init__(self, count: int, least_shared: int) -> None:
        self._least = least_shared
        self._N, self._rhs = PRIOR * np.eye(count), np.zeros(count)
        self._histogram = np.zeros((count, BINS), np.int64)

    def add(self, paints: list[tuple[int, Paint]]) -> None:
        """The stretches of one tile."""
        levels = [(k, paint.voxel, level_of(paint)) for k, paint in paints]
        for n, (k, voxel, level) in enumerate(levels):
            place = (np.clip(level, LOWEST, HIGHEST - 1e-9) - LOWEST) / (HIGHEST - LOWEST) * BINS
            self._histogram[k] += np.bincount(place.astype(np.int64), minlength=BINS)
            for j, other, its_level in levels[:n]:
                _, mine, its = np.intersect1d(voxel, other, assume_unique=True, return_indices=True)
                if j != k and len(mine) >= self._least:
                    self._compare(k, j, float(np.median(level[mine] - its_level[its])), len(mine))

    def _compare(self, k: int, j: int, brighter: float, shared: int) -> None:
        w = float(min(shared, MOST_SHARED))
        self._N[k, k] += w
        self._N[j, j] += w
        self._N[k, j] -= w
        self._N[j, k] -= w
        self._rhs[k] += w * brighter
        self._rhs[j] -= w * brighter

    def factors(self, grey: float) -> F8:
        """What the light of each stretch (count,) is to be multiplied with."""
        brighter = np.linalg.solve(self._N, self._rhs)
        middles = LOWEST + (np.arange(BINS) + 0.5) * (HIGHEST - LOWEST) / BINS
        levels = (middles[None, :] - brighter[:, None]).ravel()
        order = np.argsort(levels, kind="stable")
        met = np.cumsum(self._histogram.ravel()[order])
        median = levels[order[np.searchsorted(met, 0.5 * met[-1])]]
        return np.asarray(grey * np.exp(-brighter - median), np.float64)


def level_of(paint: Paint) -> F8:
    """Logarithm of luminance (n,) of each voxel."""
    light = (paint.light / Paint.LIGHT_STEPS) @ LUMINANCE
    return np.asarray(np.log(np.maximum(light / (paint.weight / Paint.WEIGHT_STEPS), 1e-9)))


def merged(paints: list[tuple[float, Paint]]) -> Colours:
    """Sums of several stretches of one tile, each with its factor."""
    voxel: NDArray[np.int64] = np.unique(np.concatenate([paint.voxel for _, paint in paints]))
    weight, views = np.zeros(len(voxel), np.int64), np.zeros(len(voxel), np.int32)
    light = np.zeros((len(voxel), 3), np.int64)
    for factor, paint in paints:
        rows = np.searchsorted(voxel, paint.voxel)
        weight[rows] += paint.weight
        light[rows] += np.rint(paint.light * factor).astype(np.int64)
        views[rows] += paint.views
    return Colours(voxel=voxel, weight=weight, light=light, views=views)
