"""How fast odometry really wanders, by GNSS: its random walk where fixes are good (variance components, methods 1.8).

Three fixes i, j, k, about L apart: the chord from i to j turns odometry into the axes of GNSS, and the chord from j to k
is compared. With white noise of variance s2 per axis, a walk of the translation of t2 per metre and one of the heading of
r2 per metre, what is left along the chord has the variance 2 s2 + t2 L, and across it 6 s2 + 2 t2 L + 2/3 r2 L^3. From
chords of several lengths the three are told apart, by variances whose tails are cut, since some fixes lie.
Positions in the plane are complex numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.fusion.drives import Drive
from scanloom.stages.geometry.se3 import F8

C16 = NDArray[np.complex128]

LENGTHS_M = (10.0, 20.0, 40.0, 80.0)
MOVED_M = 0.05
LEAST_CHORDS = 30
LEAST_LENGTHS = 3
LEAST_SHARE = 0.7
"""Of L that both chords must span: around a corner the turn of the first says little of the second."""
TO_SIGMA, TAILS = 1.4826, 4.0
ROUNDS = 20
SAFETY = 1.3
"""Variances of chords that overlap come out low."""


@dataclass(frozen=True)
class Walk:
    """Random walks per root of way, and the noise of a fix from one to the next."""

    rotation_rad_sqrt_m: float
    translation_m_sqrt_m: float
    noise_m: float


def random_walk(p: C16, q: C16, way_m: F8) -> Walk | None:
    """From antenna positions by odometry p (n,) and by GNSS q (n,), m, at way (n,), fixes that agree; None when too few."""
    rows, values = [], []
    for length in LENGTHS_M:
        off = _differences(p, q, way_m, length)
        if len(off) >= LEAST_CHORDS:
            rows += [[2.0, length, 0.0], [6.0, 2.0 * length, 2.0 / 3.0 * length**3]]
            values += [_variance(off.real), _variance(off.imag)]
    if len(values) < 2 * LEAST_LENGTHS:
        return None
    s2, t2, r2 = _components(np.array(rows), np.array(values))
    return Walk(float(np.sqrt(r2)), float(np.sqrt(t2)), float(np.sqrt(s2)))


def believed(
    set_walk: tuple[float, float], seen: Walk, stated_rad: float, stated_m: float, factor: float
) -> tuple[float, float]:
    """Random walk (rad, m, per root of way) to add to what odometry states itself, so that both together are as seen.

    It stays within `factor` of what is set, either way, and is not made smaller than the noise of the fixes lets see.
    """
    length = LENGTHS_M[-1]
    hidden = seen.noise_m * np.array([np.sqrt(4.5 / length**3), np.sqrt(1.0 / length)])
    found = SAFETY * np.array([seen.rotation_rad_sqrt_m, seen.translation_m_sqrt_m])
    usual, own = np.array(set_walk), np.array([stated_rad, stated_m])
    missing = np.sqrt(np.maximum(found**2 - own**2, 0.0))
    walk = np.clip(np.maximum(missing, np.minimum(usual, hidden)), usual / factor, usual * factor)
    return float(walk[0]), float(walk[1])


def stated(drive: Drive) -> tuple[float, float]:
    """What odometry states of its steps, as a random walk of the heading (rad) and along x (m) per root of way."""
    way = np.diff(drive.travelled_m)
    moved = np.flatnonzero(way > MOVED_M) + 1
    if not len(moved):
        return 0.0, 0.0
    variance = np.diagonal(drive.step_covariance()[moved], axis1=1, axis2=2)[:, [2, 3]]
    rotation, translation = np.sqrt(np.median(variance / way[moved - 1, None], axis=0))
    return float(rotation), float(translation)


def _differences(p: C16, q: C16, way_m: F8, length_m: float) -> C16:
    """What the second chord of each three fixes is off by: along it, and across it to the left, m."""
    i = np.arange(len(p))
    j = np.searchsorted(way_m, way_m + length_m)
    i, j = i[j < len(p)], j[j < len(p)]
    k = np.searchsorted(way_m, way_m[j] + length_m)
    i, j, k = i[k < len(p)], j[k < len(p)], k[k < len(p)]
    a, b, first, second = p[j] - p[i], p[k] - p[j], q[j] - q[i], q[k] - q[j]
    far = way_m[k] - way_m[i] < 3.0 * length_m
    fine = (np.minimum(np.abs(a), np.abs(b)) > LEAST_SHARE * length_m) & (np.abs(first) > 0) & far
    turn = (first * np.conj(a))[fine]
    expected = b[fine] * turn / np.abs(turn)
    return np.asarray((second[fine] - expected) * np.conj(expected) / np.abs(expected))


def _variance(values: F8) -> float:
    """About the median, since a scale or a steady turn is no walk; tails count up to four robust standard deviations."""
    off = np.abs(values - np.median(values))
    return float(np.mean(np.minimum(off, TAILS * TO_SIGMA * np.median(off)) ** 2))


def _components(A: F8, v: F8) -> F8:
    """Variances (3,), none negative, for which A x fits v (m,) in relative terms; reweighted by what they predict."""
    from scipy.optimize import nnls

    weight = 1.0 / np.maximum(v, 1e-12)
    x = np.zeros(A.shape[1])
    for _ in range(ROUNDS):
        x, _ = nnls(A * weight[:, None], v * weight)
        weight = 1.0 / np.maximum(np.sqrt((A @ x) * v), 1e-12)
    return np.asarray(x)
