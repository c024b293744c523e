"""Which parked cars of the simulated town left between two days, and which of them were reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.town import Thing, build_town

NEAR_M = 20.0
"""A car farther from the new drive than this is out of its reach."""
LEAST_POINTS = 15
"""Points of the old map that a car needs to be called seen on the first day."""
FOUND_SHARE = 1 / 3
AROUND_M = 0.3
"""Points so far outside of a car's box still belong to it."""


@dataclass(frozen=True)
class Bay:
    """A car of the first day, and whether another one stands there on the second."""

    car: Thing
    taken_again: bool


@dataclass(frozen=True)
class GoneScores:
    """Cars that left and were in reach, found ones; objects reported, true ones; share of points that are true."""

    left: int
    found: int
    objects: int
    true: int
    true_points: float


def bays(town_seed: int = 0, first_day: int = 0, second_day: int = 1) -> list[Bay]:
    """The parked cars of the first day."""
    before, after = (
        [thing for thing in build_town(town_seed, day).things if thing.what == "car"]
        for day in (first_day, second_day)
    )
    return [Bay(car, any(_overlap(car, other) for other in after)) for car in before]


def gone_scores(
    parked: Sequence[Bay], points: F8, number: NDArray[np.int32], asked: F8, path: F8
) -> GoneScores:
    """How well `points` (n, 3), of objects `number` (n,), are the cars that left; all in the town's frame, m.

    `asked` (m, 3) are the standing points of the old map, `path` (k, 3) is the new session's. A car left when its place
    is empty on the second day, and counts when the old map has 15 points of it and the new drive comes within 20 m.
    Objects in a bay that another car took count neither way.
    """
    left = [bay.car for bay in parked if not bay.taken_again]
    again = [bay.car for bay in parked if bay.taken_again]
    counted = [car for car in left if _near(car, path) and inside(car, asked).sum() >= LEAST_POINTS]
    found = sum(inside(car, points).sum() >= FOUND_SHARE * inside(car, asked).sum() for car in counted)
    in_left, in_again = _in_any(left, points), _in_any(again, points)
    objects = true = 0
    for k in np.unique(number):
        mine = number == k
        if in_again[mine].mean() > 0.5:
            continue
        objects += 1
        true += bool(in_left[mine].mean() > 0.5)
    share = float((in_left | in_again).mean()) if len(points) else float("nan")
    return GoneScores(len(counted), int(found), objects, true, share)


def inside(car: Thing, points: F8) -> NDArray[np.bool_]:
    """Which of `points` (n, 3) lie in the box of a car, or 0.3 m around it."""
    c, s = np.cos(car.yaw_rad), np.sin(car.yaw_rad)
    off = points - car.centre
    own = np.column_stack((c * off[:, 0] + s * off[:, 1], -s * off[:, 0] + c * off[:, 1], off[:, 2]))
    return np.asarray((np.abs(own) <= car.size_m / 2 + AROUND_M).all(axis=1))


def _in_any(cars: Sequence[Thing], points: F8) -> NDArray[np.bool_]:
    found = np.zeros(len(points), bool)
    for car in cars:
        found |= inside(car, points)
    return found


def _near(car: Thing, path: F8) -> bool:
    return float(np.linalg.norm(path[:, :2] - car.centre[:2], axis=1).min()) <= NEAR_M


def _overlap(a: Thing, b: Thing) -> bool:
    """Whether two cars stand in the same place: bays are 6.3 m apart, so their middles tell."""
    return float(np.linalg.norm(a.centre[:2] - b.centre[:2])) < 0.5 * float(a.size_m[0] + b.size_m[0])
