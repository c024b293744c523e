"""Pose of a board of known size from everything the sensor says about it: ranges, edges and squares, in one fit.

Unknown beside the pose: by how much beams of some width make the board look larger, by how much dark print reads farther
than bright print, and for every beam its error of range and what it calls dark and bright.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.edges import Edges
from scanloom.stages.calibrate.cloud.outline import outside_by
from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.pattern import dark_share
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.calibrate.cloud.sweep import B1, I8, Sweep
from scanloom.stages.geometry.se3 import F8, se3_exp

_ROUNDS = 4
_FLARE_SIGMA_M = 0.008
"""How much larger a board may look on each side."""
_DARK_SIGMA_M = 0.015
"""How much farther dark print may read."""
_EDGE_SIGMA_M = 0.003
"""How unevenly an edge is hit, beyond the distance of two rays."""
_FEWEST_ON_BEAM = 8
"""Points of a beam, at least, for its dark and bright to be told."""
_LEAST_CONTRAST = 1e-9
_POSE, _FLARE, _DARKER = slice(0, 6), 6, 7


@dataclass(frozen=True)
class Seen:
    """What is known of one candidate, ray by ray."""

    board: Board
    direction: F8
    range_m: F8
    intensity: F8
    beam: I8
    """0, 1, ... without gaps."""
    inner: B1
    """Not at the end of a run: the range is the board's alone."""
    edges: Edges
    width_m: float
    """Of the beam at the board."""
    first_dark: bool
    squares: bool
    """The reflectance is used."""
    range_sigma_m: float
    beam_sigma_m: float


@dataclass(frozen=True)
class PoseFit:
    """A pose and how well everything agrees with it."""

    T_lidar_board: F8
    covariance: F8
    flare_m: float
    darker_m: float
    cost: float
    contrast: float
    """Correlation of the reflectance with the print, beam by beam; 0 where it is not used."""
    rmse_m: float
    seen: Seen


def seen_of(sweep: Sweep, patch: Patch, edges: Edges, board: Board, settings: CloudSettings) -> Seen:
    rays = patch.rays
    beam = sweep.beam[rays]
    change = np.diff(beam) != 0
    inner = ~(np.concatenate(([True], change)) | np.concatenate((change, [True])))
    distance = float(np.median(sweep.range_m[rays]))
    return Seen(
        board=board,
        direction=sweep.direction[rays],
        range_m=sweep.range_m[rays],
        intensity=sweep.intensity[rays],
        beam=np.unique(beam, return_inverse=True)[1],
        inner=inner,
        edges=edges,
        width_m=settings.footprint_m + settings.divergence_rad * distance,
        first_dark=True,
        squares=False,
        range_sigma_m=settings.range_sigma_m,
        beam_sigma_m=settings.beam_sigma_m,
    )


def fitted(seen: Seen, T_start: F8, rounds: int = _ROUNDS) -> PoseFit:
    """The pose near a start, by robust least squares; scatter is taken from the residuals and weighed anew each round."""
    from scipy.optimize import least_squares

    T, nuisance = T_start, np.zeros(2)
    for _ in range(rounds):
        scales = _scales(seen, T, nuisance)
        here = T

        def residuals(x: F8, here: F8 = here, scales: _Scales = scales) -> F8:
            return _residuals(seen, here @ se3_exp(x[_POSE]), x[6:], scales)

        fit = least_squares(
            residuals,
            np.concatenate((np.zeros(6), nuisance)),
            loss="cauchy",
            f_scale=2.5,
            x_scale=_STEPS,
            max_nfev=30,
        )
        T, nuisance = here @ se3_exp(fit.x[_POSE]), fit.x[6:]
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)[_POSE, _POSE]
    gap, _ = _range_gaps(seen, T, nuisance)
    contrast = _contrast(seen, T)
    rmse = float(np.sqrt(np.mean(gap**2)))
    return PoseFit(
        T, covariance, float(nuisance[0]), float(nuisance[1]), float(fit.cost), contrast, rmse, seen
    )


_STEPS = np.array([0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.005, 0.005])


@dataclass(frozen=True)
class _Scales:
    """Standard deviations of this round."""

    range_m: float
    beam_m: float
    edge_m: F8
    light: F8
    """Of the reflectance, by beam; infinite where it tells nothing."""


def _scales(seen: Seen, T: F8, nuisance: F8) -> _Scales:
    gap, beam = _range_gaps(seen, T, nuisance)
    mean = _beam_means(gap, beam, seen.beam.max() + 1)
    within = 1.4826 * np.median(np.abs(gap - mean[beam]))
    sigma = float(np.clip(within, 0.2 * seen.range_sigma_m, 5 * seen.range_sigma_m))
    counts = np.bincount(beam, minlength=len(mean))
    used = counts > 2
    between = (
        float(np.sum(np.minimum(mean[used] ** 2, 0.05**2) - sigma**2 / counts[used])) if used.any() else 0.0
    )
    prior = 4.0
    beam_sigma = np.sqrt(max(between + prior * seen.beam_sigma_m**2, 1e-8) / (max(used.sum() - 3, 0) + prior))
    on, off = (outside(seen, T, d) for d in (seen.edges.on, seen.edges.off))
    spread = np.minimum(
        np.abs(off - on), np.linalg.norm(_hits(T, seen.edges.on) - _hits(T, seen.edges.off), axis=1)
    )
    edge = np.sqrt(spread**2 / 12 + _EDGE_SIGMA_M**2) / np.sqrt(seen.edges.weight)
    return _Scales(sigma, float(beam_sigma), edge, _light_scales(seen, T))


def _light_scales(seen: Seen, T: F8) -> F8:
    beams = seen.beam.max() + 1
    if not seen.squares:
        return np.full(beams, np.inf)
    off, gain = _light_gaps(seen, T)
    out = np.full(beams, np.inf)
    for k in range(beams):
        mine = seen.beam == k
        if mine.sum() >= _FEWEST_ON_BEAM and gain[k] > _LEAST_CONTRAST:
            out[k] = max(1.4826 * np.median(np.abs(off[mine])), np.std(off[mine]) / 2, 0.05 * gain[k])
    return out


def _residuals(seen: Seen, T: F8, nuisance: F8, scales: _Scales) -> F8:
    gap, beam = _range_gaps(seen, T, nuisance)
    count = np.bincount(beam, minlength=seen.beam.max() + 1)
    mean = _beam_means(gap, beam, len(count))
    # square root of the inverse of s^2 I + b^2 11': the mean of a beam is trusted less than its points say
    shrink = 1 - 1 / np.sqrt(1 + count * (scales.beam_m / scales.range_m) ** 2)
    ranges = (gap - (shrink * mean)[beam]) / scales.range_m
    middle = seen.edges.on + seen.edges.off
    edges = (outside(seen, T, middle) - np.where(seen.edges.across, 0.0, nuisance[0])) / scales.edge_m
    prior = nuisance / (_FLARE_SIGMA_M, _DARK_SIGMA_M)
    if not seen.squares:
        return np.concatenate((ranges, edges, prior))
    light, _ = _light_gaps(seen, T)
    return np.concatenate((ranges, edges, prior, light / scales.light[seen.beam]))


def _hits(T: F8, directions: F8) -> F8:
    """Where rays (n, 3) meet the board's plane (n, 2), in its frame."""
    n = T[:3, 2]
    slope = np.minimum(directions @ n, -1e-3 * np.linalg.norm(directions, axis=1))
    hit = directions * ((n @ T[:3, 3]) / slope)[:, None]
    out: F8 = (hit - T[:3, 3]) @ T[:3, :2]
    return out


def outside(seen: Seen, T: F8, directions: F8) -> F8:
    """By how much rays (n, 3) pass the board, m; negative on it."""
    board = seen.board
    return outside_by(_hits(T, directions), np.asarray(board.offset_m), 0.0, np.asarray(board.board_m) / 2)


def _dark(seen: Seen, T: F8, which: B1 | slice = slice(None)) -> F8:
    directions = seen.direction[which]
    blur = np.full(len(directions), max(seen.width_m / 4, 1e-3))
    return dark_share(seen.board, seen.first_dark, _hits(T, directions), blur)


def _range_gaps(seen: Seen, T: F8, nuisance: F8) -> tuple[F8, I8]:
    """Measured minus expected range of the inner rays, m, and their beams."""
    n = T[:3, 2]
    directions = seen.direction[seen.inner]
    expected = (n @ T[:3, 3]) / np.minimum(directions @ n, -1e-3)
    if seen.squares:
        expected = expected + nuisance[1] * (_dark(seen, T, seen.inner) - 0.5)
    return seen.range_m[seen.inner] - expected, seen.beam[seen.inner]


def _beam_means(values: F8, beam: I8, beams: int) -> F8:
    count = np.maximum(np.bincount(beam, minlength=beams), 1)
    return np.asarray(np.bincount(beam, weights=values, minlength=beams) / count, np.float64)


def _light_gaps(seen: Seen, T: F8) -> tuple[F8, F8]:
    """Reflectance minus what a straight line from dark to bright says, beam by beam; and its rise by beam."""
    bright = 1.0 - _dark(seen, T)
    beams = int(seen.beam.max()) + 1
    mean_b, mean_i = (_beam_means(v, seen.beam, beams)[seen.beam] for v in (bright, seen.intensity))
    b, i = bright - mean_b, seen.intensity - mean_i
    rise = np.bincount(seen.beam, weights=b * i, minlength=beams)
    room = np.bincount(seen.beam, weights=b * b, minlength=beams)
    gain = np.maximum(rise, 0.0) / np.maximum(room, 1e-3)
    return i - gain[seen.beam] * b, gain


def _contrast(seen: Seen, T: F8) -> float:
    bright = 1.0 - _dark(seen, T)
    beams = int(seen.beam.max()) + 1
    b = bright - _beam_means(bright, seen.beam, beams)[seen.beam]
    i = seen.intensity - _beam_means(seen.intensity, seen.beam, beams)[seen.beam]
    scale = np.sqrt(_beam_means(i * i, seen.beam, beams))[seen.beam]
    i = np.divide(i, scale, out=np.zeros_like(i), where=scale > _LEAST_CONTRAST)
    size = np.sqrt((b @ b) * (i @ i))
    return float(b @ i / size) if size > 0 else 0.0


def with_squares(seen: Seen, first_dark: bool) -> Seen:
    return replace(seen, squares=True, first_dark=first_dark)


def contrast_of(seen: Seen, T: F8) -> float:
    """Correlation of the reflectance with the print at a pose."""
    return _contrast(seen, T)
