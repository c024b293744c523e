"""The small turn at which a camera fits best, and how sure it is: from the images, and from some of them drawn again and
again."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, product, repeat

import numpy as np

from scanloom.stages.camera_check.distance import B1, F4, Scene, greys, nid, scene
from scanloom.stages.camera_check.views import View
from scanloom.stages.geometry.se3 import F8

WIDEST_RAD = np.radians(2.0)
COARSE_STEPS = 11
"""Per axis (the two that move the whole picture alike), over twice the widest turn."""
COARSE_EVERY = 3
COARSE_BLUR_PX, FINE_BLUR_PX = 4.0, 1.0
REACHES_RAD = tuple(np.radians(reach) for reach in (0.4, 0.25, 0.15, 0.15))
"""Half width of the neighbourhood in which the distance is taken for a paraboloid, step after step."""
MORE_STEPS, STILL_RAD = 6, np.radians(0.01)
"""Of the last reach, and the step that is none."""
HELD_RAD = np.radians(1.8)
"""From none, all reaches together lead 1.85 deg about z, and about x and y the search stops at the widest turn: a fit from there on may be no minimum."""
DESIGN = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
DRAWS, BLOCK = 100, 4
"""Drawn sets of images; images in a row, that see much the same, are drawn together."""
FLOOR_RAD = np.radians(0.04)
"""What drawing cannot show: an error that all images share. Turns of cameras that stood still were off by so much."""
SEED = 7


@dataclass(frozen=True)
class Fit:
    """What was found; turns are vectors about the camera's axes which take points from where they were to where they fit."""

    turn_rad: F8
    std_rad: F8
    """By drawing images again (Efron, Annals of Statistics 7, 1979), and the error they share."""
    nid: float
    nid_best: float
    gain_std: float
    """How much better than none a turn is for images that had no part in finding it, over the standard deviation of that."""
    points: int
    held: bool
    """Whether it is as far away as can be searched: the best may be farther."""

    @property
    def size_rad(self) -> float:
        return float(np.linalg.norm(self.turn_rad))


def best_turn(views: list[View], calibrated: list[View] | None = None) -> Fit:
    """From the best of a coarse grid with blurred images, and from no turn at all, by paraboloids; the better of both.

    The same is done with every other block of images alone and with the rest, also from the turn of all: where both halves
    prefer another turn, as they do where images tell nothing, the scatter is that between them. None is the camera as it is in `calibrated`: other views of the same images, or the same.
    """
    halves = [np.arange(len(views)) // BLOCK % 2 == half for half in (0, 1)]
    parts = [np.ones(len(views), bool), *halves]
    (start, *starts), grey = _coarse(views, parts), greys(views, FINE_BLUR_PX)
    turn = _found(views, grey, start)
    apart = [_found(*_only(views, grey, half), own, turn) for half, own in zip(halves, starts, strict=True)]
    drawn = _draws(len(views))
    compared = scene(views, grey, margin_rad=WIDEST_RAD, at=np.zeros(3))
    none = scene(calibrated, grey, margin_rad=WIDEST_RAD, at=np.zeros(3)) if calibrated else compared
    before, after = none.histograms(np.zeros(3)), compared.histograms(turn)
    by_other = np.where(
        halves[0][:, None, None, None], *(compared.histograms(other) for other in apart[::-1])
    )
    gain = nid(_summed(drawn, before)) - nid(_summed(drawn, by_other))
    near = scene(views, grey, margin_rad=WIDEST_RAD, at=turn)
    scatter = _minima(near, REACHES_RAD[-1], drawn).std(axis=0, ddof=1)
    scatter = np.maximum(scatter, 0.5 * np.abs(apart[0] - apart[1]))
    return Fit(
        turn, np.hypot(scatter, FLOOR_RAD), float(nid(before.sum(axis=0))), float(nid(after.sum(axis=0))),
        float(gain.mean() / max(float(gain.std(ddof=1)), 1e-12)), len(compared.kind),
        bool(np.abs(turn).max() > HELD_RAD),
    )  # fmt: skip


def comparable(views: list[View]) -> int:
    """Steps that stay in the image whatever the turn."""
    return len(scene(views, np.empty(0, np.float32), margin_rad=WIDEST_RAD, at=np.zeros(3)).kind)


def _draws(count: int) -> F8:
    """(DRAWS, count): how often each image is drawn."""
    blocks = -(-count // BLOCK)
    often = np.random.default_rng(SEED).multinomial(blocks, np.full(blocks, 1.0 / blocks), DRAWS)
    return np.asarray(np.repeat(often, BLOCK, axis=1)[:, :count].astype(float))


def _summed(often: F8, joint: F8) -> F8:
    """Histograms (sets, ...) of sets of images from those (images, ...) of each."""
    return np.asarray(np.tensordot(often, joint, axes=(1, 0)))


def _coarse(views: list[View], parts: list[B1]) -> list[F8]:
    """The best of a grid of turns about x and y, for each choice of images; about z nothing is tried yet."""
    grey = greys(views, COARSE_BLUR_PX)
    blurred = scene(views, grey, margin_rad=WIDEST_RAD, at=np.zeros(3), every=COARSE_EVERY)
    steps = np.linspace(-WIDEST_RAD, WIDEST_RAD, COARSE_STEPS)
    turns = np.array([(x, y, 0.0) for x in steps for y in steps])
    joint = np.array([blurred.histograms(turn) for turn in turns])
    return [np.asarray(turns[int(np.argmin(nid(joint[:, part].sum(axis=1))))]) for part in parts]


def _only(views: list[View], grey: F4, part: B1) -> tuple[list[View], F4]:
    """Some of the views, and their images."""
    return [view for view, use in zip(views, part, strict=True) if use], grey.reshape(len(views), -1)[
        part
    ].ravel()


def _found(views: list[View], grey: F4, coarse: F8, fine: F8 | None = None) -> F8:
    """Best turn from a coarse one on, and from none, and from a fine one, whichever ends best."""
    starts = [np.zeros(3), coarse] if coarse.any() else [np.zeros(3)]
    ends = [_descended(views, grey, start) for start in starts]
    if fine is not None:
        ends.append(_descended(views, grey, fine, REACHES_RAD[2:]))
    compared = scene(views, grey, margin_rad=WIDEST_RAD, at=np.zeros(3))
    return ends[int(np.argmin([nid(compared.histograms(end).sum(axis=0)) for end in ends]))]


def _descended(views: list[View], grey: F4, turn: F8, reaches_rad: tuple[float, ...] = REACHES_RAD) -> F8:
    """By one step of each reach, and by more of the last one until they are small."""
    everything = np.ones((1, len(views)))
    reaches = chain(reaches_rad, repeat(reaches_rad[-1], MORE_STEPS))
    for number, reach in enumerate(reaches, 1):
        near = scene(views, grey, margin_rad=WIDEST_RAD, at=turn)
        ahead: F8 = np.clip(turn + _minima(near, reach, everything)[0], -WIDEST_RAD, WIDEST_RAD)
        if number >= len(reaches_rad) and np.abs(ahead - turn).max() < STILL_RAD:
            return ahead
        turn = ahead
    return turn


def _minima(near: Scene, reach: float, often: F8) -> F8:
    """Minima (sets, 3) of paraboloids about where a scene is, for sets of its images."""
    offsets = DESIGN * reach
    values = np.column_stack([nid(_summed(often, near.histograms(offset))) for offset in offsets])
    return np.array([_minimum(offsets, row, reach) for row in values])


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
