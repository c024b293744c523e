"""Turns too large to be found from none: where a search from none ends at its limit or in doubt, a grid about all three axes
says where else to begin, and the images are held against the scans again from there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.camera_check.distance import B1, Scene, gathered, greys, nid
from scanloom.stages.camera_check.search import BLOCK, COARSE_BLUR_PX, Fit, best_turn, comparable
from scanloom.stages.camera_check.views import View
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8, so3_exp, so3_log

GRID_RAD, GRID_STEPS = np.radians(2.0), 5
"""From one turn of the grid to the next about each axis, and how many either way: a search finds its end from more than half of that."""
EVERY = 5
KEPT = 0.9
"""Of what a fit at the limit tells of the images the one about it has to tell: other steps are in the image there."""
FOLLOWED = 3
"""Searches one after the other, each from the limit of the one before."""
LEAST_STEPS = 1000
"""That stay in the image at all turns of the grid, or from one of them on; a lens too narrow for the grid is searched from none only."""


def farther(views: list[View], near: Fit, seen: Callable[[F8], list[View]], doubt_rad: float) -> Fit:
    """The best fit from elsewhere, if it is better than the one from none, inside of what was searched, and known to `doubt_rad`.

    `seen` gives the views of the camera whose points are turned by a vector about its axes."""
    starts = ([near.turn_rad] if near.held else []) + _starts(views)
    fits = [fit for start in starts if (fit := _followed(start, views, seen)) is not None]
    told = (1.0 - near.nid_best) * (KEPT if near.held else 1.0)
    better = [
        fit for fit in fits if not fit.held and fit.std_rad.max() < doubt_rad and 1.0 - fit.nid_best > told
    ]
    return min(better, key=lambda fit: fit.nid_best, default=near)


def _followed(start: F8, calibrated: list[View], seen: Callable[[F8], list[View]]) -> Fit | None:
    """What fits best about a turn, and how much better than none it is; from where a search ends at its limit another one begins."""
    fit = None
    for _ in range(FOLLOWED):
        views = seen(start)
        if comparable(views) < LEAST_STEPS:
            return None
        about = best_turn(views, calibrated)
        start = so3_log(so3_exp(about.turn_rad) @ so3_exp(start))
        fit = replace(about, turn_rad=start)
        if not fit.held:
            break
    return fit


def _starts(views: list[View]) -> list[F8]:
    """Where all images, and each half of them, fit best on the grid; none itself is no start, and a lens too narrow has no grid."""
    half = np.arange(len(views)) // BLOCK % 2
    parts = [np.ones(len(views), bool), half == 0, half == 1]
    axis = GRID_RAD * np.arange(-GRID_STEPS, GRID_STEPS + 1)
    turns = np.array(list(product(axis, repeat=3)))
    places, staying = _staying(views, turns[np.isin(np.abs(turns), (0.0, axis[-1])).all(axis=1)])
    if len(staying.kind) < LEAST_STEPS:
        return []
    joint = np.array([_joint(staying, views[0].model, places, turn, parts) for turn in turns])
    best = np.unique(nid(joint).argmin(axis=0))
    return [turns[number] for number in best if turns[number].any()]


def _staying(views: list[View], extremes: F8) -> tuple[list[F8], Scene]:
    """The places of steps that stay in the image at the largest turns, and the blurred images they are compared with."""
    places, kind, across, number = gathered(views, EVERY)
    model = views[0].model
    size = np.array([model.width_px, model.height_px])
    inner = np.ones(len(kind), bool)
    for turn, xyz in product(extremes, places):
        pixel, seen = project(model, xyz @ so3_exp(turn).T)
        with np.errstate(invalid="ignore"):
            inner &= seen & ((pixel > 0.0) & (pixel < size - 2)).all(axis=1)
    left = int(inner.sum())
    grey = greys(views, COARSE_BLUR_PX)
    return [xyz[inner] for xyz in places], Scene(
        group=number[inner], groups=len(views), kind=kind[inner], across=across[inner], pixel=np.empty((2, left, 2)),
        slope=np.zeros((2, left, 2, 3)), width=model.width_px, height=model.height_px, grey=grey,
    )  # fmt: skip


def _joint(staying: Scene, model: CameraModel, places: list[F8], turn: F8, parts: list[B1]) -> F8:
    """Histograms (parts, across, kind, difference) at a turn for which slopes do not do: every place is projected."""
    pixel = np.stack([project(model, xyz @ so3_exp(turn).T)[0] for xyz in places])
    # between the largest turns a bent lens may take a place a little beyond the edge
    inside = np.clip(np.nan_to_num(pixel), 0.0, (staying.width - 2, staying.height - 2))
    joint = replace(staying, pixel=np.ascontiguousarray(inside)).histograms(np.zeros(3))
    return np.array([joint[part].sum(axis=0) for part in parts])
