"""Who follows a script of their own: where along the road, how far aside of it, and when there at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8, pose
from scanloom.stages.simulate.meshes import Mesh
from scanloom.stages.simulate.motion import rotations
from scanloom.stages.simulate.route import Path
from scanloom.stages.simulate.terrain import Terrain

SLOPE_M = 1.0
DECK_M = 0.7
"""Where the road is so much above or below the ground, it is a bridge's."""
BESIDE_M, BEFORE_M = 0.25, 0.8
"""Room between two that move, beside and before them."""

Aside = Callable[[F8, F8], F8]
"""Offset to the left (n,) m of the driven line at arc lengths (n,) m and times (n,) s."""


@dataclass(frozen=True)
class Guest:
    """A moving object with a script."""

    name: str
    what: str
    mesh: Mesh
    terrain: Terrain
    arc: Callable[[F8], F8]
    """Arc length (n,) m at times (n,) s."""
    left: Aside
    meets_s: float
    """About when the vehicle passes."""
    backwards: bool = False
    turn_rad: float = 0.0
    """Looks so far to the left of where the line leads."""
    present_s: tuple[float, float] = (-np.inf, np.inf)
    stays_s: float = np.inf
    """Stands for good from this time on."""

    def kind(self, t: float) -> PointClass:
        """What stands for good is part of the town like any parked car."""
        return PointClass.STATIC if t >= self.stays_s else PointClass.DYNAMIC

    def present(self, t: F8) -> NDArray[np.bool_]:
        return (t >= self.present_s[0]) & (t <= self.present_s[1])

    def poses(self, path: Path, t: F8) -> F8:
        """T_world_guest (n, 4, 4): on the ground, along its slope."""
        s = self.arc(t)
        p = self._place(path, s, t)
        ahead = self._place(path, s + SLOPE_M, t) - p
        ahead = -ahead if self.backwards else ahead
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0]) + self.turn_rad
        pitch = -np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1])) * np.cos(self.turn_rad)
        return pose(rotations(np.zeros(len(t)), pitch, yaw), p)

    def _place(self, path: Path, s: F8, t: F8) -> F8:
        heading, p = path.heading(s), path.at(s)
        p[:, :2] += self.left(s, t)[:, None] * np.column_stack((-np.sin(heading), np.cos(heading)))
        ground = self.terrain.height(p[:, 0], p[:, 1])
        p[:, 2] = np.where(np.abs(ground - p[:, 2]) < DECK_M, ground, p[:, 2])
        return p


def through(*stops: tuple[float, float]) -> Callable[[F8], F8]:
    """Monotone smooth progress through (time s, arc length m); at rest between two of the same arc length.

    Beyond the ends it goes on as fast as in the first and the last stretch.
    """
    t, s = np.array(stops, float).T
    far = 1e4
    before, after = (s[1] - s[0]) / (t[1] - t[0]), (s[-1] - s[-2]) / (t[-1] - t[-2])
    t = np.concatenate(([t[0] - far], t, [t[-1] + far]))
    s = np.concatenate(([s[0] - far * before], s, [s[-1] + far * after]))
    curve = PchipInterpolator(t, s)
    return lambda at: np.asarray(curve(at), float)


@dataclass(frozen=True)
class Footprint:
    """Poses of a mover (n, 4, 4) at the times of a check, its length and width, and when it is there."""

    T: F8
    size_m: tuple[float, float]
    present: NDArray[np.bool_]


def clash(a: Footprint, b: Footprint) -> bool:
    """Whether two get into each other's way at any time when both are there: no side of either box separates them."""
    both = np.flatnonzero(a.present & b.present)
    if len(both) == 0:
        return False
    return bool((_overlap(a, b, both) & _overlap(b, a, both)).any())


def _overlap(a: Footprint, b: Footprint, at: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether box b, seen along the axes of a, overlaps a with its margins."""
    apart = np.einsum("nij,ni->nj", a.T[at, :2, :2], b.T[at, :2, 3] - a.T[at, :2, 3])
    cos = np.abs(np.einsum("ni,ni->n", a.T[at, :2, 0], b.T[at, :2, 0]))
    sin = np.sqrt(np.maximum(1 - cos**2, 0))
    (length, width), (long, wide) = a.size_m, b.size_m
    before = np.abs(apart[:, 0]) < (length + cos * long + sin * wide) / 2 + BEFORE_M
    beside = np.abs(apart[:, 1]) < (width + cos * wide + sin * long) / 2 + BESIDE_M
    hit: NDArray[np.bool_] = before & beside
    return hit
