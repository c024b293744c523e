"""Pose of a board of known size from everything the sensor says about it: ranges, edges and squares, in one fit.

Unknown beside the pose: by how much beams of some width make the board look larger, by how much dark print reads farther
than bright print, where the beams cross, by how much all ranges are off, and for every beam its error of range and what it calls dark and bright.

Clouds are written as if all beams left the origin. In many sensors they do not: those of a VLP-16 cross 42 mm before its
axis (its manual's table of vertical offsets, 11.2 mm at 15 degrees), which few drivers know. A point at elevation e is then
h tan(e) lower than the cloud says, and a board at 2 m looks 2 % too tall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.edges import Edges
from scanloom.stages.calibrate.cloud.evidence import Evidence, evidence_of
from scanloom.stages.calibrate.cloud.outline import outside_by
from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.pattern import dark_share
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.calibrate.cloud.sweep import B1, I8, Sweep
from scanloom.stages.geometry.se3 import F8, se3_exp

_ROUNDS = 4
_STEPS_A_ROUND = 4
_OUTLIER = 2.5
"""Standard deviations from which an error is trusted less (Cauchy)."""
_FLARE_SIGMA_M = 0.008
"""How much larger a board may look on each side."""
_DARK_SIGMA_M = 0.015
"""How much farther dark print may read."""
_CROSSING_SIGMA_M = 0.03
"""How far before or behind the axis beams may cross."""
_FARTHER_SIGMA_M = 0.02
"""How much too far all ranges may read; sheets of sensors promise 30 mm."""
SENSOR_SIGMA_M = np.array([_FLARE_SIGMA_M, _DARK_SIGMA_M, _CROSSING_SIGMA_M, _FARTHER_SIGMA_M])
_EDGE_SIGMA_M = 0.003
"""How unevenly an edge is hit, beyond the distance of two rays."""
_ALIKE = 2.0
"""Neighbouring rays err alike where the blur is not quite as assumed: four of them count as one."""
_FACING = 0.35
"""Sine of the angle between a beam and a side from which it crosses it."""
_FLUSH_M = 0.015
"""By how much a ray may pass the outline, beyond the width of the beam, and still be the board's."""
_FEWEST_ON_BEAM = 8
"""Points of a beam, at least, for its dark and bright to be told."""
_LEAST_CONTRAST = 1e-9
_POSE, _SENSOR = slice(0, 6), slice(6, 10)


@dataclass(frozen=True)
class Seen:
    """What is known of one candidate, ray by ray."""

    board: Board
    direction: F8
    range_m: F8
    intensity: F8
    beam: I8
    """0, 1, ... without gaps."""
    beams: I8
    """What the sensor calls them."""
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
    crossing_m: float
    farther_m: float
    cost: float
    contrast: float
    """Correlation of the reflectance with the print, beam by beam; 0 where it is not used."""
    rmse_m: float
    beam_sigma_m: float
    evidence: Evidence
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
        beams=sweep.name[np.unique(beam)],
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
    T, sensor, damping = T_start, np.zeros(len(SENSOR_SIGMA_M)), 1e-3
    for _ in range(rounds):
        scales = _scales(seen, T, sensor)
        for _ in range(_STEPS_A_ROUND):
            T, sensor, damping = _stepped(seen, T, sensor, scales, damping)
    errors, slopes = _linear(seen, T, sensor, scales)
    gap, _ = _range_gaps(seen, T, sensor)
    return PoseFit(
        T_lidar_board=T,
        covariance=_inverse(_information(errors, slopes) + np.diag(_UNKNOWN))[_POSE, _POSE]
        + np.diag(_BENT**2),
        flare_m=float(sensor[0]),
        darker_m=float(sensor[1]),
        crossing_m=float(sensor[2]),
        farther_m=float(sensor[3]),
        cost=_cost(errors),
        contrast=_contrast(seen, T, float(sensor[2])),
        rmse_m=float(np.sqrt(np.mean(gap**2))),
        beam_sigma_m=scales.beam_m,
        evidence=_evidence(seen, T, sensor, scales),
        seen=seen,
    )


def _stepped(seen: Seen, T: F8, sensor: F8, scales: _Scales, damping: float) -> tuple[F8, F8, float]:
    """One step of Levenberg and Marquardt with Cauchy's weights; the damping that is right for the next."""
    errors, slopes = _linear(seen, T, sensor, scales)
    weight = 1 / (1 + (errors / _OUTLIER) ** 2)
    H, g = _information(errors, slopes), slopes.T @ (weight * errors)
    before = _cost(errors)
    for _ in range(4):
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-9 * np.eye(len(H)), g)
        ahead, shared = T @ se3_exp(step[_POSE]), sensor + step[_SENSOR]
        if _cost(_residuals(seen, ahead, shared, scales)) <= before:
            return ahead, shared, max(damping / 10, 1e-7)
        damping *= 10
    return T, sensor, damping


def _linear(seen: Seen, T: F8, sensor: F8, scales: _Scales) -> tuple[F8, F8]:
    """Errors (n,) and their derivatives (n, 10), by differences."""
    errors = _residuals(seen, T, sensor, scales)
    ahead = [
        _residuals(seen, T @ se3_exp(step[_POSE]), sensor + step[_SENSOR], scales)
        for step in _SLIGHT * np.eye(10)
    ]
    return errors, np.stack([(e - errors) / _SLIGHT for e in ahead], axis=1)


def _information(errors: F8, slopes: F8) -> F8:
    weight = 1 / (1 + (errors / _OUTLIER) ** 2)
    return np.asarray(slopes.T @ (weight[:, None] * slopes), np.float64)


def _inverse(matrix: F8) -> F8:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _cost(errors: F8) -> float:
    return float(0.5 * _OUTLIER**2 * np.log1p((errors / _OUTLIER) ** 2).sum())


def _evidence(seen: Seen, T: F8, sensor: F8, scales: _Scales) -> Evidence:
    """The linear system at the solution: beams' errors of range as unknowns of their own, outliers weighed down."""
    gap, beam = _range_gaps(seen, T, sensor)
    count = np.bincount(beam, minlength=len(seen.beams))
    share = count * scales.beam_m**2 / (count * scales.beam_m**2 + scales.range_m**2)
    offsets = share * _beam_means(gap, beam, len(seen.beams))

    def errors(x: F8) -> F8:
        return _errors(seen, T @ se3_exp(x[_POSE]), sensor + x[_SENSOR], scales, offsets)

    here = errors(np.zeros(10))
    weight = 1 / np.sqrt(1 + (here / _OUTLIER) ** 2)
    columns = [(errors(_SLIGHT * e) - errors(-_SLIGHT * e)) / (2 * _SLIGHT) for e in np.eye(10)]
    by_beam = np.zeros((len(here), len(seen.beams)))
    by_beam[np.arange(len(beam)), beam] = -1 / scales.range_m
    slopes = np.column_stack((*columns, by_beam)) * weight[:, None]
    at = np.concatenate((np.zeros(6), sensor, offsets))
    return evidence_of(T, seen.beams, slopes, weight * here - slopes @ at)


_SLIGHT = 1e-5
_BENT = np.concatenate((np.full(3, 5e-4), np.full(3, 7e-4)))
"""What no board is known better than, rad and m: print that is not quite in its place, a plate that is not quite flat."""
_UNKNOWN = np.concatenate((np.full(3, 1.0), np.full(3, 4.0), np.zeros(4)))
"""Information of a board of which nothing is known: 1 rad and 0.5 m."""


@dataclass(frozen=True)
class _Scales:
    """Standard deviations of this round."""

    range_m: float
    beam_m: float
    edge_m: F8
    light: F8
    """Of the reflectance, by beam; infinite where it tells nothing."""


def _scales(seen: Seen, T: F8, sensor: F8) -> _Scales:
    gap, beam = _range_gaps(seen, T, sensor)
    mean = _beam_means(gap, beam, seen.beam.max() + 1)
    within = 1.4826 * np.median(np.abs(gap - mean[beam]))
    sigma = float(np.clip(within, 0.2 * seen.range_sigma_m, 5 * seen.range_sigma_m))
    counts = np.bincount(beam, minlength=len(mean))
    used = counts > 2
    mean = mean - (np.median(mean[used]) if used.any() else 0.0)
    between = (
        float(np.sum(np.minimum(mean[used] ** 2, 0.05**2) - sigma**2 / counts[used])) if used.any() else 0.0
    )
    prior = 4.0
    beam_sigma = np.sqrt(max(between + prior * seen.beam_sigma_m**2, 1e-8) / (max(used.sum() - 3, 0) + prior))
    distance, _ = _crossed(seen, T, sensor[2])
    edge = np.sqrt(distance[1] ** 2 / 12 + _EDGE_SIGMA_M**2) / np.sqrt(seen.edges.weight)
    return _Scales(sigma, float(beam_sigma), edge, _light_scales(seen, T, sensor))


def _light_scales(seen: Seen, T: F8, sensor: F8) -> F8:
    beams = seen.beam.max() + 1
    if not seen.squares:
        return np.full(beams, np.inf)
    off, gain = _light_gaps(seen, T, sensor[2])
    out = np.full(beams, np.inf)
    for k in range(beams):
        mine = seen.beam == k
        if mine.sum() >= _FEWEST_ON_BEAM and gain[k] > _LEAST_CONTRAST:
            out[k] = _ALIKE * max(
                1.4826 * np.median(np.abs(off[mine])), np.std(off[mine]) / 2, 0.05 * gain[k]
            )
    return out


def _errors(seen: Seen, T: F8, sensor: F8, scales: _Scales, offsets: F8) -> F8:
    """Everything in units of its noise, for known errors of the beams (k,) and without priors."""
    gap, beam = _range_gaps(seen, T, sensor)
    return np.concatenate(((gap - offsets[beam]) / scales.range_m, _other_errors(seen, T, sensor, scales)))


def _residuals(seen: Seen, T: F8, sensor: F8, scales: _Scales) -> F8:
    gap, beam = _range_gaps(seen, T, sensor)
    count = np.bincount(beam, minlength=seen.beam.max() + 1)
    mean = _beam_means(gap, beam, len(count))
    # square root of the inverse of s^2 I + b^2 11': the mean of a beam is trusted less than its points say
    shrink = 1 - 1 / np.sqrt(1 + count * (scales.beam_m / scales.range_m) ** 2)
    ranges = (gap - (shrink * mean)[beam]) / scales.range_m
    prior = sensor / SENSOR_SIGMA_M
    return np.concatenate((ranges, prior, _other_errors(seen, T, sensor, scales)))


def _other_errors(seen: Seen, T: F8, sensor: F8, scales: _Scales) -> F8:
    distance, _ = _crossed(seen, T, sensor[2])
    edges = (distance[0] - np.where(seen.edges.across, 0.0, sensor[0])) / scales.edge_m
    if not seen.squares:
        return edges
    light, _ = _light_gaps(seen, T, sensor[2])
    return np.concatenate((edges, light / scales.light[seen.beam]))


def _reach(T: F8, directions: F8, crossing_m: float) -> tuple[F8, F8]:
    """Range (n,) at which rays (n, 3) meet the board's plane, and by how much they start below the origin (n,)."""
    n = T[:3, 2]
    slope = np.minimum(directions @ n, -1e-3)
    low = crossing_m * directions[:, 2] / np.hypot(directions[:, 0], directions[:, 1])
    return (n @ T[:3, 3] + low * n[2]) / slope, low


def _crossed(seen: Seen, T: F8, crossing_m: float) -> tuple[tuple[F8, F8], I8]:
    """Of each pair of rays with an edge between: distances (e,), m, and the side of the outline that they cross.

    The first distance is that of the middle from the side, positive outside, the second is how far apart the rays are
    across it. Only sides that face the way from the one to the other count: a beam that runs along a side tells nothing
    of it.
    """
    edges = seen.edges
    on, off = (_hits(T, d, crossing_m) for d in (edges.on, edges.off))
    way = off - on
    length = np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)
    middle = (on + off) / 2 - np.asarray(seen.board.offset_m)
    depth = np.sign(way) * middle - np.asarray(seen.board.board_m) / 2
    facing = np.abs(way) > _FACING * length[:, None]
    axis = np.argmax(np.where(facing, depth, -np.inf), axis=1)
    row = np.arange(len(axis))
    positive = way[row, axis] > 0
    side = np.where(axis == 0, np.where(positive, 1, 3), np.where(positive, 2, 0))
    return (depth[row, axis], np.abs(way[row, axis])), side


def _hits(T: F8, directions: F8, crossing_m: float) -> F8:
    """Where rays (n, 3) meet the board's plane (n, 2), in its frame."""
    reach, low = _reach(T, directions, crossing_m)
    hit = directions * reach[:, None] - T[:3, 3]
    hit[:, 2] -= low
    out: F8 = hit @ T[:3, :2]
    return out


def outside(seen: Seen, T: F8, directions: F8, crossing_m: float) -> F8:
    """By how much rays (n, 3) pass the board, m; negative on it."""
    board = seen.board
    hits = _hits(T, directions, crossing_m)
    return outside_by(hits, np.asarray(board.offset_m), 0.0, np.asarray(board.board_m) / 2)


def _dark(seen: Seen, T: F8, crossing_m: float, which: B1 | slice = slice(None)) -> F8:
    directions = seen.direction[which]
    blur = np.full(len(directions), max(seen.width_m / 4, 1e-3))
    return dark_share(seen.board, seen.first_dark, _hits(T, directions, crossing_m), blur)


def _range_gaps(seen: Seen, T: F8, sensor: F8) -> tuple[F8, I8]:
    """Measured minus expected range of the inner rays, m, and their beams."""
    reach, _ = _reach(T, seen.direction[seen.inner], sensor[2])
    expected = reach + sensor[3]
    if seen.squares:
        expected = expected + sensor[1] * (_dark(seen, T, sensor[2], seen.inner) - 0.5)
    return seen.range_m[seen.inner] - expected, seen.beam[seen.inner]


def _beam_means(values: F8, beam: I8, beams: int) -> F8:
    count = np.maximum(np.bincount(beam, minlength=beams), 1)
    return np.asarray(np.bincount(beam, weights=values, minlength=beams) / count, np.float64)


def _light_gaps(seen: Seen, T: F8, crossing_m: float) -> tuple[F8, F8]:
    """Reflectance minus what a straight line from dark to bright says, beam by beam; and its rise by beam."""
    bright = 1.0 - _dark(seen, T, crossing_m)
    beams = int(seen.beam.max()) + 1
    mean_b, mean_i = (_beam_means(v, seen.beam, beams)[seen.beam] for v in (bright, seen.intensity))
    b, i = bright - mean_b, seen.intensity - mean_i
    rise = np.bincount(seen.beam, weights=b * i, minlength=beams)
    room = np.bincount(seen.beam, weights=b * b, minlength=beams)
    gain = np.maximum(rise, 0.0) / np.maximum(room, 1e-3)
    return i - gain[seen.beam] * b, gain


def _contrast(seen: Seen, T: F8, crossing_m: float) -> float:
    bright = 1.0 - _dark(seen, T, crossing_m)
    beams = int(seen.beam.max()) + 1
    b = bright - _beam_means(bright, seen.beam, beams)[seen.beam]
    i = seen.intensity - _beam_means(seen.intensity, seen.beam, beams)[seen.beam]
    scale = np.sqrt(_beam_means(i * i, seen.beam, beams))[seen.beam]
    i = np.divide(i, scale, out=np.zeros_like(i), where=scale > _LEAST_CONTRAST)
    size = np.sqrt((b @ b) * (i @ i))
    return float(b @ i / size) if size > 0 else 0.0


def with_squares(seen: Seen, first_dark: bool) -> Seen:
    return replace(seen, squares=True, first_dark=first_dark)


def trimmed(seen: Seen, T: F8) -> Seen:
    """Without the rays and edges that are clearly not the board's: hands and what else is flush with it.

    All of it where little would be left: then this is no board.
    """
    limit = seen.width_m + _FLUSH_M
    on = outside(seen, T, seen.direction, 0.0) < limit
    middle = seen.edges.on + seen.edges.off
    near = np.abs(outside(seen, T, middle / np.linalg.norm(middle, axis=1)[:, None], 0.0)) < limit
    near |= seen.edges.across
    if (on.all() and near.all()) or on.mean() < 0.5 or (near & ~seen.edges.across).sum() < 4:
        return seen
    names, beam = np.unique(seen.beam[on], return_inverse=True)
    edges = seen.edges
    return replace(
        seen,
        direction=seen.direction[on],
        range_m=seen.range_m[on],
        intensity=seen.intensity[on],
        beam=beam.astype(np.int64),
        beams=seen.beams[names],
        inner=seen.inner[on],
        edges=Edges(
            edges.on[near], edges.off[near], edges.left[near], edges.across[near], edges.weight[near]
        ),
    )


def contrast_of(seen: Seen, T: F8) -> float:
    """Correlation of the reflectance with the print at a pose, beam by beam."""
    return _contrast(seen, T, 0.0)


def agreement(seen: Seen, T: F8) -> float:
    """How well edges and squares agree with a pose: minus their cost, the scatter of the reflectance taken from itself."""
    sensor = np.zeros(len(SENSOR_SIGMA_M))
    contrast = min(max(_contrast(seen, T, 0.0), 0.0), 0.99)
    edges = _other_errors(
        replace(seen, squares=False), T, sensor, _scales(replace(seen, squares=False), T, sensor)
    )
    return float(-len(seen.beam) / (2 * _ALIKE**2) * np.log1p(-(contrast**2)) - _cost(edges))
