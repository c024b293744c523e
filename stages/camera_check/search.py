"""The small turn at which a camera fits best, and how sure it is: from the images, and from all but a part of them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from scanloom.stages.camera_check.distance import nid, scene
from scanloom.stages.camera_check.views import View
from scanloom.stages.geometry.se3 import F8

WIDEST_RAD = np.radians(2.0)
COARSE_STEPS = 9
"""Per axis (the two that move the whole picture alike), over twice the widest turn."""
COARSE_BLUR_PX, FINE_BLUR_PX = 4.0, 1.5
REACHES_RAD = tuple(np.radians(reach) for reach in (0.5, 0.35, 0.3))
"""Half width of the neighbourhood in which the distance is taken for a paraboloid, step after step."""
DESIGN = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class Fit:
    """What was found; turns are vectors about the camera's axes which take points from where they were to where they fit."""

    turn_rad: F8
    std_rad: F8
    nid: float
    nid_best: float
    gain_std: float
    """How much better a turn is for images that had no part in finding it, over the standard deviation of that."""
    points: int


def best_turn(views: list[View], group: list[int]) -> Fit:
    """Search coarsely with blurred images, then by paraboloids; the same in every other group of images alone and in the rest.

    The spread is that of leaving out one group after the other, or of the two halves where that is larger. The gain is
    that of each group by the turn of the half it is not in.
    """
    halves = [[g % 2 == half for g in range(max(group) + 1)] for half in (0, 1)]
    starts = _coarse(views, group, [[True] * (max(group) + 1), *halves])
    turns = _found(views, group, starts[0])
    turn, without = turns[0], turns[1:]
    of_half = [
        _found(*_only(views, group, half), start)[0] for half, start in zip(halves, starts[1:], strict=True)
    ]
    count = len(without)
    jackknife = np.sqrt((count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    std = np.maximum(jackknife, 0.5 * np.abs(of_half[0] - of_half[1]))
    compared = scene(views, group, blur_px=FINE_BLUR_PX, margin_rad=WIDEST_RAD, at=np.zeros(3))
    before, after = compared.histograms(np.zeros(3)), compared.histograms(turn)
    by_other = [compared.histograms(other) for other in reversed(of_half)]
    gains = np.array([nid(before[g]) - nid(by_other[g % 2][g]) for g in range(count)])
    gain = gains.mean() / max(gains.std(ddof=1) / np.sqrt(count), 1e-12)
    whole, best = (float(nid(joint.sum(axis=0))) for joint in (before, after))
    return Fit(turn, std, whole, best, float(gain), len(compared.rank))


def _coarse(views: list[View], group: list[int], parts: list[list[bool]]) -> list[F8]:
    """The best of a grid of turns about x and y, for each choice of groups; about z nothing is tried yet."""
    blurred = scene(views, group, blur_px=COARSE_BLUR_PX, margin_rad=WIDEST_RAD, at=np.zeros(3))
    steps = np.linspace(-WIDEST_RAD, WIDEST_RAD, COARSE_STEPS)
    turns = np.array([(x, y, 0.0) for x in steps for y in steps])
    joint = np.array([blurred.histograms(turn) for turn in turns])
    return [np.asarray(turns[int(np.argmin(nid(joint[:, part].sum(axis=1))))]) for part in parts]


def _only(views: list[View], group: list[int], part: list[bool]) -> tuple[list[View], list[int]]:
    """Views of some groups, and these groups numbered anew."""
    number = np.cumsum(part) - 1
    rows = [n for n, g in enumerate(group) if part[g]]
    return [views[n] for n in rows], [int(number[group[n]]) for n in rows]


def _found(views: list[View], group: list[int], start: F8) -> F8:
    """Best turns (1 + groups, 3) from a start on: of all groups, then of all but each."""
    turns = start[None]
    for reach in REACHES_RAD:
        turns = _refined(views, group, turns[0], reach)
    return turns


def _refined(views: list[View], group: list[int], at: F8, reach: float) -> F8:
    """Minima (1 + groups, 3) of paraboloids about `at`."""
    near = scene(views, group, blur_px=FINE_BLUR_PX, margin_rad=WIDEST_RAD, at=at)
    offsets = DESIGN * reach
    joint = np.array([near.histograms(offset) for offset in offsets])
    total = joint.sum(axis=1)
    values = np.column_stack((nid(total), *(nid(total - joint[:, g]) for g in range(near.groups))))
    turns = at + np.array([_minimum(offsets, column, reach) for column in values.T])
    return np.asarray(np.clip(turns, -WIDEST_RAD, WIDEST_RAD))


def _minimum(offsets: F8, values: F8, reach: float) -> F8:
    """Of the paraboloid through the values, at most `reach` away on every axis."""
    x, y, z = (offsets / reach).T
    terms = np.column_stack((np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z))
    c = np.linalg.lstsq(terms, values, rcond=None)[0]
    hessian = np.array([[2 * c[4], c[7], c[8]], [c[7], 2 * c[5], c[9]], [c[8], c[9], 2 * c[6]]])
    # where it does not curve upwards it only says which way is down
    scale, axes = np.linalg.eigh(hessian)
    scale = np.maximum(scale, 1e-2 * max(scale[-1], 1e-9))
    step = -axes @ ((axes.T @ c[1:4]) / scale)
    return np.asarray(np.clip(step, -1.0, 1.0) * reach)
