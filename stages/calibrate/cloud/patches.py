"""Flat pieces of a cloud that are no larger than a board: what a board may be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.calibrate.cloud.sweep import B1, I8, Sweep
from scanloom.stages.geometry.se3 import F8

_TRIALS = 48
_SAMPLE = 240
"""Points a plane is tried on."""
_STRAYS = 2
"""Returns from elsewhere between two points of one run: noise; more are an edge."""
_HOLE = 1.5
"""Squares that may be missing in a run: dark ones may not answer."""
_ROUNDS = 4
_AGAIN = 0.6
"""Share of rays that another piece had before: the same once more."""


@dataclass(frozen=True)
class Patch:
    """A flat piece: its rays, and all rays around it."""

    window: I8
    """Rays of the sweep around it, sorted by beam and azimuth."""
    inside: B1
    """(window,) which of them are on it."""
    normal: F8
    """(3,) unit, towards the sensor."""
    distance_m: float
    """Of the plane from the sensor: normal . p = -distance."""
    tolerance_m: float
    """How far its points may be from the plane."""

    @property
    def rays(self) -> I8:
        return self.window[self.inside]


def patches(sweep: Sweep, board: Board, settings: CloudSettings) -> Iterator[Patch]:
    """Pieces of planes that hang together and are not wider than the board's diagonal and a third of it."""
    diagonal = float(np.hypot(*board.board_m))
    points = sweep.points
    taken = np.zeros(sweep.source.max() + 1, np.bool_)
    free = sweep.foreground & (sweep.range_m < settings.max_range_m)
    rng = np.random.default_rng(settings.seed)
    for seed in _seeds(sweep, points, free, min(board.board_m) / 2):
        if not free[seed]:
            continue
        half = np.arcsin(min(1.4 * diagonal / sweep.range_m[seed] / 2 * 2, 0.99))
        window = sweep.window(float(sweep.azimuth[seed]), float(half))
        found = _grown(sweep, points, window, seed, board, settings, rng)
        if found is None:
            free[seed] = False
            continue
        patch, reach = found
        mine = patch.rays
        again = taken[sweep.source[mine]].mean() > _AGAIN
        taken[sweep.source[mine]] = True
        near = np.linalg.norm(points[mine] - points[seed], axis=1) < (
            np.inf if reach < 1.3 * diagonal else diagonal / 2
        )
        _mark(sweep, free, mine[near])
        free[seed] = False
        if reach < 1.3 * diagonal and not again:
            yield patch


def _mark(sweep: Sweep, free: B1, rays: I8) -> None:
    """Rays that are explained are no seeds any more, nor are their copies behind the seam."""
    known = np.zeros(sweep.source.max() + 1, np.bool_)
    known[sweep.source[rays]] = True
    free &= ~known[sweep.source]


def _seeds(sweep: Sweep, points: F8, free: B1, size_m: float) -> I8:
    """One ray in every cube of the foreground, away from both ends of the azimuths; the nearest first."""
    inner = free & (sweep.azimuth >= -np.pi + 1.0) & (sweep.azimuth < np.pi + 1.0)
    rays = np.flatnonzero(inner)
    cells = np.floor(points[rays] / size_m)
    off = np.linalg.norm(points[rays] / size_m - cells - 0.5, axis=1)
    order = np.lexsort((off, *cells.T))
    fresh = np.ones(len(order), np.bool_)
    fresh[1:] = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    seeds = rays[order[fresh]]
    return seeds[np.argsort(sweep.range_m[seeds], kind="stable")]


def _grown(
    sweep: Sweep,
    points: F8,
    window: I8,
    seed: int,
    board: Board,
    settings: CloudSettings,
    rng: np.random.Generator,
) -> tuple[Patch, float] | None:
    """The piece of a plane around a seed, and its largest distance between two points; None where there is none."""
    around = points[window]
    away = np.linalg.norm(around - points[seed], axis=1)
    near = np.flatnonzero(away < min(board.board_m) / 2)
    if len(near) < 12 or len(np.unique(sweep.beam[window[near]])) < 3:
        return None
    plane = _tried_plane(around[near], settings.plane_m, rng)
    tolerance = settings.plane_m
    inside = np.zeros(len(window), np.bool_)
    for _ in range(_ROUNDS):
        normal, distance = plane
        flat = np.abs(around @ normal + distance) < tolerance
        hole = _HOLE * board.square_m
        inside = _connected(
            sweep, window, around, flat & sweep.foreground[window], int(near[np.argmin(away[near])]), hole
        )
        if inside.sum() < settings.min_points:
            return None
        plane = _fitted(around[inside])
        spread = 1.4826 * np.median(np.abs(around[inside] @ plane[0] + plane[1]))
        tolerance = float(np.clip(3.0 * spread, settings.plane_m, 2.5 * settings.plane_m))
    if len(np.unique(sweep.beam[window[inside]])) < settings.min_rings:
        return None
    return Patch(window, inside, plane[0], plane[1], tolerance), _reach(around[inside])


def _tried_plane(points: F8, tolerance: float, rng: np.random.Generator) -> tuple[F8, float]:
    """The plane of three points that most points are near to (RANSAC, Fischler and Bolles 1981)."""
    p = points[rng.permutation(len(points))[:_SAMPLE]]
    a, b, c = (p[rng.integers(len(p), size=_TRIALS)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals[length > 1e-9] /= length[length > 1e-9, None]
    off = np.abs(p @ normals.T - np.einsum("ij,ij->i", a, normals))
    score = np.where(length > 1e-4, (off < tolerance).sum(axis=0), -1)
    best = int(np.argmax(score))
    return _fitted(p[off[:, best] < tolerance])


def _fitted(points: F8) -> tuple[F8, float]:
    """Normal towards the origin, and distance d with n . p + d = 0."""
    centre = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - centre, full_matrices=False)
    normal = axes[2] if len(axes) > 2 else np.array([0.0, 0.0, 1.0])
    normal = normal if normal @ centre < 0 else -normal
    return normal, float(-normal @ centre)


def _reach(points: F8) -> float:
    """Largest extent along 18 directions in the plane of the points."""
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    flat = centred @ axes[:2].T
    angle = np.linspace(0, np.pi, 18, endpoint=False)
    return float(np.ptp(flat @ np.stack((np.cos(angle), np.sin(angle))), axis=0).max())


def _connected(sweep: Sweep, window: I8, points: F8, flat: B1, seed: int, hole_m: float) -> B1:
    """Those of the flat rays that hang together with the one nearest to the seed.

    Runs along a beam end where several returns from elsewhere lie between, or where the hole is too wide. Runs of
    neighbouring beams hang together where their azimuths overlap.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    out = np.zeros(len(window), np.bool_)
    on = np.flatnonzero(flat)
    if not len(on):
        return out
    beam, azimuth = sweep.beam[window[on]], sweep.azimuth[window[on]]
    gap = np.linalg.norm(np.diff(points[on], axis=0), axis=1)
    breaks = (np.diff(beam) != 0) | (np.diff(on) > _STRAYS + 1) | (gap > hole_m)
    run = np.concatenate(([0], np.cumsum(breaks)))
    first = np.flatnonzero(np.concatenate(([True], breaks)))
    last = np.append(first[1:], len(on)) - 1
    low, high = azimuth[first] - sweep.step_rad[beam[first]], azimuth[last] + sweep.step_rad[beam[first]]
    step = beam[first][None, :] - beam[first][:, None]
    touch = (step == 1) & (low[:, None] < high[None, :]) & (low[None, :] < high[:, None])
    a, b = np.nonzero(touch)
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(first), len(first)))
    _, piece = connected_components(graph, directed=False)
    start = on[int(np.argmin(np.linalg.norm(points[on] - points[seed], axis=1)))]
    out[on] = piece[run] == piece[run[np.searchsorted(on, start)]]
    return out
