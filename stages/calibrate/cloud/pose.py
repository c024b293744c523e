"""Pose of a board of known size from everything the sensor says about it: ranges, edges and squares, in one fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.calibrate.cloud.candidate import Seen
from scanloom.stages.calibrate.cloud.evidence import SENSOR, Evidence, evidence_of
from scanloom.stages.calibrate.cloud.misfit import (
    OUTLIER,
    SENSOR_SIGMA_M,
    Scales,
    beam_means,
    contrast,
    cost,
    errors_of,
    range_gaps,
    residuals,
    scales_of,
    shading,
)
from scanloom.stages.geometry.se3 import F8, se3_exp

_ROUNDS = 4
_STEPS_A_ROUND = 4
_POSE, _SENSOR = slice(0, 6), slice(6, 10)
_SHADING = (*range(6), 6 + SENSOR.index("crossing_m"))
"""Unknowns that move the print under the rays."""


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


def fitted(seen: Seen, T_start: F8, rounds: int = _ROUNDS) -> PoseFit:
    """The pose near a start, by robust least squares; scatter is taken from the residuals and weighed anew each round."""
    T, sensor, damping = T_start, np.zeros(len(SENSOR_SIGMA_M)), 1e-3
    for _ in range(rounds):
        scales = scales_of(seen, T, sensor)
        for _ in range(_STEPS_A_ROUND):
            T, sensor, damping = _stepped(seen, T, sensor, scales, damping)
    errors, slopes = _linear(seen, T, sensor, scales)
    gap, _ = range_gaps(seen, T, sensor, shading(seen, T, sensor))
    return PoseFit(
        T_lidar_board=T,
        covariance=_inverse(_information(errors, slopes) + np.diag(_UNKNOWN))[_POSE, _POSE]
        + np.diag(_BENT**2),
        flare_m=float(sensor[0]),
        darker_m=float(sensor[1]),
        crossing_m=float(sensor[2]),
        farther_m=float(sensor[3]),
        cost=cost(errors),
        contrast=contrast(seen, T, float(sensor[2])),
        rmse_m=float(np.sqrt(np.mean(gap**2))),
        beam_sigma_m=scales.beam_m,
        evidence=_evidence(seen, T, sensor, scales),
        seen=seen,
    )


def _stepped(seen: Seen, T: F8, sensor: F8, scales: Scales, damping: float) -> tuple[F8, F8, float]:
    """One step of Levenberg and Marquardt with Cauchy's weights; the damping that is right for the next."""
    errors, slopes = _linear(seen, T, sensor, scales)
    weight = 1 / (1 + (errors / OUTLIER) ** 2)
    H, g = _information(errors, slopes), slopes.T @ (weight * errors)
    before = cost(errors)
    for _ in range(4):
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-9 * np.eye(len(H)), g)
        ahead, shared = T @ se3_exp(step[_POSE]), sensor + step[_SENSOR]
        if cost(residuals(seen, ahead, shared, scales, shading(seen, ahead, shared))) <= before:
            return ahead, shared, max(damping / 10, 1e-7)
        damping *= 10
    return T, sensor, damping


def _linear(seen: Seen, T: F8, sensor: F8, scales: Scales) -> tuple[F8, F8]:
    """Errors (n,) and their derivatives (n, 10), by differences."""
    shade = shading(seen, T, sensor)
    errors = residuals(seen, T, sensor, scales, shade)
    slopes = []
    for k, step in enumerate(_SLIGHT * np.eye(10)):
        ahead, shared = (T @ se3_exp(step[_POSE]) if k < 6 else T), sensor + step[_SENSOR]
        there = shading(seen, ahead, shared) if k in _SHADING else shade
        slopes.append((residuals(seen, ahead, shared, scales, there) - errors) / _SLIGHT)
    return errors, np.stack(slopes, axis=1)


def _information(errors: F8, slopes: F8) -> F8:
    weight = 1 / (1 + (errors / OUTLIER) ** 2)
    return np.asarray(slopes.T @ (weight[:, None] * slopes), np.float64)


def _inverse(matrix: F8) -> F8:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _evidence(seen: Seen, T: F8, sensor: F8, scales: Scales) -> Evidence:
    """The linear system at the solution: beams' errors of range as unknowns of their own, outliers weighed down."""
    gap, beam = range_gaps(seen, T, sensor, shading(seen, T, sensor))
    count = np.bincount(beam, minlength=len(seen.beams))
    share = count * scales.beam_m**2 / (count * scales.beam_m**2 + scales.range_m**2)
    offsets = share * beam_means(gap, beam, len(seen.beams))

    def errors(x: F8) -> F8:
        return errors_of(seen, T @ se3_exp(x[_POSE]), sensor + x[_SENSOR], scales, offsets)

    here = errors(np.zeros(10))
    weight = 1 / np.sqrt(1 + (here / OUTLIER) ** 2)
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
