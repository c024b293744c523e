"""How far everything a cloud says about a board is from what a pose of it foretells, in units of its noise.

Unknown beside the pose, as `SENSOR` names them: by how much beams of some width make the board look larger, by how much dark
print reads farther than bright print, where the beams cross, by how much all ranges are off; and for every beam its error
of range and what it calls dark and bright.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanloom.stages.calibrate.cloud.candidate import Seen
from scanloom.stages.calibrate.cloud.hits import crossed, dark, reach
from scanloom.stages.calibrate.cloud.sweep import I8
from scanloom.stages.geometry.se3 import F8

OUTLIER = 2.5
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
_FEWEST_ON_BEAM = 8
"""Points of a beam, at least, for its dark and bright to be told."""
_LEAST_CONTRAST = 1e-9


@dataclass(frozen=True)
class Scales:
    """Standard deviations of this round."""

    range_m: float
    beam_m: float
    edge_m: F8
    light: F8
    """Of the reflectance, by beam; infinite where it tells nothing."""


def scales_of(seen: Seen, T: F8, sensor: F8) -> Scales:
    shade = shading(seen, T, sensor)
    gap, beam = range_gaps(seen, T, sensor, shade)
    mean = beam_means(gap, beam, seen.beam.max() + 1)
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
    distance, _ = crossed(seen, T, sensor[2])
    edge = np.sqrt(distance[1] ** 2 / 12 + _EDGE_SIGMA_M**2) / np.sqrt(seen.edges.weight)
    return Scales(sigma, float(beam_sigma), edge, _light_scales(seen, shade))


def _light_scales(seen: Seen, shade: F8 | None) -> F8:
    beams = seen.beam.max() + 1
    if shade is None:
        return np.full(beams, np.inf)
    off, gain = light_gaps(seen, shade)
    out = np.full(beams, np.inf)
    for k in range(beams):
        mine = seen.beam == k
        if mine.sum() >= _FEWEST_ON_BEAM and gain[k] > _LEAST_CONTRAST:
            out[k] = _ALIKE * max(
                1.4826 * np.median(np.abs(off[mine])), np.std(off[mine]) / 2, 0.05 * gain[k]
            )
    return out


def errors_of(seen: Seen, T: F8, sensor: F8, scales: Scales, offsets: F8) -> F8:
    """Everything in units of its noise, for known errors of the beams (k,) and without priors."""
    shade = shading(seen, T, sensor)
    gap, beam = range_gaps(seen, T, sensor, shade)
    others = other_errors(seen, T, sensor, scales, shade)
    return np.concatenate(((gap - offsets[beam]) / scales.range_m, others))


def residuals(seen: Seen, T: F8, sensor: F8, scales: Scales, shade: F8 | None) -> F8:
    """The same with priors, and with beams' errors of range that are not known; `shade` is that of the pose."""
    gap, beam = range_gaps(seen, T, sensor, shade)
    count = np.bincount(beam, minlength=seen.beam.max() + 1)
    mean = beam_means(gap, beam, len(count))
    # square root of the inverse of s^2 I + b^2 11': the mean of a beam is trusted less than its points say
    shrink = 1 - 1 / np.sqrt(1 + count * (scales.beam_m / scales.range_m) ** 2)
    ranges = (gap - (shrink * mean)[beam]) / scales.range_m
    prior = sensor / SENSOR_SIGMA_M
    return np.concatenate((ranges, prior, other_errors(seen, T, sensor, scales, shade)))


def shading(seen: Seen, T: F8, sensor: F8) -> F8 | None:
    """Share (n,) of dark print under every ray; None where squares are not looked at."""
    return dark(seen, T, sensor[2]) if seen.squares else None


def other_errors(seen: Seen, T: F8, sensor: F8, scales: Scales, shade: F8 | None) -> F8:
    """Of edges and squares."""
    distance, _ = crossed(seen, T, sensor[2])
    edges = (distance[0] - np.where(seen.edges.across, 0.0, sensor[0])) / scales.edge_m
    if shade is None:
        return edges
    light, _ = light_gaps(seen, shade)
    return np.concatenate((edges, light / scales.light[seen.beam]))


def range_gaps(seen: Seen, T: F8, sensor: F8, shade: F8 | None) -> tuple[F8, I8]:
    """Measured minus expected range of the inner rays, m, and their beams."""
    away, _ = reach(T, seen.direction[seen.inner], sensor[2])
    expected = away + sensor[3]
    if shade is not None:
        expected = expected + sensor[1] * (shade[seen.inner] - 0.5)
    return seen.range_m[seen.inner] - expected, seen.beam[seen.inner]


def beam_means(values: F8, beam: I8, beams: int) -> F8:
    count = np.maximum(np.bincount(beam, minlength=beams), 1)
    return np.asarray(np.bincount(beam, weights=values, minlength=beams) / count, np.float64)


def light_gaps(seen: Seen, shade: F8) -> tuple[F8, F8]:
    """Reflectance minus what a straight line from dark to bright says, beam by beam; and its rise by beam."""
    bright = 1.0 - shade
    beams = int(seen.beam.max()) + 1
    mean_b, mean_i = (beam_means(v, seen.beam, beams)[seen.beam] for v in (bright, seen.intensity))
    b, i = bright - mean_b, seen.intensity - mean_i
    rise = np.bincount(seen.beam, weights=b * i, minlength=beams)
    room = np.bincount(seen.beam, weights=b * b, minlength=beams)
    gain = np.maximum(rise, 0.0) / np.maximum(room, 1e-3)
    return i - gain[seen.beam] * b, gain


def contrast(seen: Seen, T: F8, crossing_m: float) -> float:
    bright = 1.0 - dark(seen, T, crossing_m)
    beams = int(seen.beam.max()) + 1
    b = bright - beam_means(bright, seen.beam, beams)[seen.beam]
    i = seen.intensity - beam_means(seen.intensity, seen.beam, beams)[seen.beam]
    scale = np.sqrt(beam_means(i * i, seen.beam, beams))[seen.beam]
    i = np.divide(i, scale, out=np.zeros_like(i), where=scale > _LEAST_CONTRAST)
    size = np.sqrt((b @ b) * (i @ i))
    return float(b @ i / size) if size > 0 else 0.0


def cost(errors: F8) -> float:
    return float(0.5 * OUTLIER**2 * np.log1p((errors / OUTLIER) ** 2).sum())


def contrast_of(seen: Seen, T: F8) -> float:
    """Correlation of the reflectance with the print at a pose, beam by beam."""
    return contrast(seen, T, 0.0)


def agreement(seen: Seen, T: F8) -> float:
    """How well edges and squares agree with a pose: minus their cost, the scatter of the reflectance taken from itself."""
    sensor = np.zeros(len(SENSOR_SIGMA_M))
    clear = min(max(contrast(seen, T, 0.0), 0.0), 0.99)
    plain = replace(seen, squares=False)
    edges = other_errors(plain, T, sensor, scales_of(plain, T, sensor), None)
    return float(-len(seen.beam) / (2 * _ALIKE**2) * np.log1p(-(clear**2)) - cost(edges))
