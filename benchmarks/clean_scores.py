"""How well a map was cleaned, with the definitions of the DynamicMap benchmark (Zhang et al., ITSC 2023).

The ground-truth cloud is every point of every scan that is truly static or dynamic, at full resolution. The output of a
system is the points it keeps. A point of the ground truth counts as kept when a kept point lies within 0.05 m.
SA = kept static / static, DA = removed dynamic / dynamic, AA = sqrt(SA DA), HA = 2 SA DA / (SA + DA), in percent.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.clean_nearness import F4, Mask, near
from scanloom.schemas.scans import PointClass

REACH_M = 0.05
RANGES_M = (0.0, 20.0, 40.0, 100.0)
STANDING = (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC)
"""Classes of what stays in a map, and of what truly stands."""
UNJUDGED = PointClass.OUT_OF_RANGE
"""True class where nobody knows it: such a point is in neither set."""


@dataclass(frozen=True)
class Accuracy:
    """Numbers of points of the ground truth, and what became of them."""

    static: int
    static_kept: int
    dynamic: int
    dynamic_removed: int

    @property
    def sa(self) -> float:
        return _percent(self.static_kept, self.static)

    @property
    def da(self) -> float:
        return _percent(self.dynamic_removed, self.dynamic)

    @property
    def aa(self) -> float:
        return float(np.sqrt(self.sa * self.da))

    @property
    def merit(self) -> float:
        """What variants are chosen by: associated accuracy, or what there is of the two."""
        found = [value for value in (self.sa, self.da) if np.isfinite(value)]
        return float(np.prod(found)) if found else 0.0

    @property
    def ha(self) -> float:
        total = self.sa + self.da
        return 2 * self.sa * self.da / total if total > 0 else float("nan") if np.isnan(total) else 0.0


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else float("nan")


def is_static(true_class: NDArray[np.uint8]) -> Mask:
    """Points of the ground truth that stand; own vehicle, particles and stray returns are in neither set."""
    return np.isin(true_class, STANDING)


def is_dynamic(true_class: NDArray[np.uint8]) -> Mask:
    """Points of the ground truth that move."""
    return true_class == PointClass.DYNAMIC


def may_stand(true_class: NDArray[np.uint8]) -> Mask:
    """Points that stand, and those that nobody knows of."""
    return np.isin(true_class, (*STANDING, UNJUDGED))


def kept_in_map(points: F4, kept: Mask, judged: Mask, reach_m: float = REACH_M) -> Mask:
    """Which points (n, 3) of the ground truth, in the map's frame, the output holds: kept, or with a kept point in reach.

    Only points that are `judged` (n,) are looked up; the others are what `kept` says.
    """
    out = kept.copy()
    asked = np.flatnonzero(judged & ~kept)
    out[asked] = near(points[asked], points[kept], reach_m)
    return out


def accuracy(static: Mask, dynamic: Mask, held: Mask) -> Accuracy:
    """Of what stands and what moves (n,), and which of it the output holds (n,)."""
    return Accuracy(
        static=int(static.sum()),
        static_kept=int((static & held).sum()),
        dynamic=int(dynamic.sum()),
        dynamic_removed=int((dynamic & ~held).sum()),
    )


def by_range(points: F4, static: Mask, dynamic: Mask, held: Mask) -> Iterator[tuple[str, Accuracy]]:
    """Accuracy in rings of distance from the sensor; `points` (n, 3) are in its frame."""
    squared = np.einsum("ni,ni->n", points, points)
    for low, high in itertools.pairwise(RANGES_M):
        ring = (squared >= low * low) & (squared < high * high)
        yield f"{low:g}_{high:g}_m", accuracy(static & ring, dynamic & ring, held)
