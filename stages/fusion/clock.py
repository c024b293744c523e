"""How late the clock of a GNSS receiver is: first roughly, from the distances between its fixes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanloom.stages.fusion.calibration import I8, Calibration, Motion
from scanloom.stages.geometry.se3 import F8

CHORD_M = 15.0
LAG_STEP_S = 0.1
LAG_CAP_M = 2.0
"""Distances that disagree by more count as this much: a lie must not outvote the rest."""
MOST_CHORDS = 2000
LEAST_CHORDS = 20
STRETCHES = 20
CLEAR_GAIN = 3.0
"""Standard errors by which stretches of the log must prefer an offset to none."""


def lag_by_distances(motions: Sequence[Motion], antenna_m: F8, most_s: float) -> float:
    """Offset, s, to add to the stamps of the fixes, with which distances between them fit odometry's best.

    Searched on a grid of 0.1 s up to `most_s` either way. Distances do not depend on how the two frames stand to each
    other, so nothing needs to be aligned yet. 0 when no offset is clearly better than none: every stretch of the log is
    asked which of the two it prefers.
    """
    half = int(np.floor(most_s / LAG_STEP_S + 1e-9))
    lags = np.asarray(LAG_STEP_S * np.arange(-half, half + 1), np.float64)
    cost = np.concatenate([_cost(motion, antenna_m, lags) for motion in motions], axis=1)
    if cost.shape[1] < LEAST_CHORDS:
        return 0.0
    best = int(np.argmin(cost.mean(axis=1) + 1e-9 * np.abs(lags)))
    gain = [part.mean() for part in np.array_split(cost[half] - cost[best], STRETCHES)]
    clear = np.mean(gain) > CLEAR_GAIN * np.std(gain) / np.sqrt(STRETCHES - 1)
    return float(lags[best]) if clear else 0.0


def _cost(motion: Motion, antenna_m: F8, lags: F8) -> F8:
    """Disagreement (lags, chords) of distances, m, up to a cap; what an offset moves out of the log costs the cap."""
    i, j = _chords(motion)
    length = np.linalg.norm(motion.fix_m[j] - motion.fix_m[i], axis=1)
    at = (motion.stamp_ns - motion.stamp_ns[0]) * 1e-9
    antenna = motion.T_level_lidar[:, :2, :3] @ antenna_m + motion.T_level_lidar[:, :2, 3]
    first, last = ((motion.fix_ns[k] - motion.stamp_ns[0]) * 1e-9 for k in (i, j))
    cost = np.full((len(lags), len(i)), LAG_CAP_M)
    for k, lag in enumerate(lags):
        known = (first + lag >= 0.0) & (last + lag <= at[-1])
        move = [np.interp(last + lag, at, c) - np.interp(first + lag, at, c) for c in antenna.T]
        cost[k, known] = np.minimum(np.abs(np.hypot(*move) - length), LAG_CAP_M)[known]
    return cost


def _chords(motion: Motion) -> tuple[I8, I8]:
    """Pairs of fixes: each with the first one after it that lies `CHORD_M` away by its own account."""
    n = len(motion.fix_ns)
    way = motion.path_at(motion.fix_ns)
    j = np.searchsorted(way, way + CHORD_M)
    i = np.flatnonzero(j < n)
    i = i[:: max(1, -(-len(i) // MOST_CHORDS))]
    return i.astype(np.int64), j[i].astype(np.int64)


CLEAR = 5.0
LEAST_OFFSET_S = 0.02
LARGEST_SIGMA_S = 0.05


def clear(found: Calibration) -> bool:
    """The clock is known well enough, and wrong."""
    offset, sigma = abs(float(found.value[0])), float(found.sigma[0])
    return sigma < LARGEST_SIGMA_S and offset > max(CLEAR * sigma, LEAST_OFFSET_S)


def said(found: Calibration) -> str:
    """What was found about the clock, in words: a late clock gives its fixes too late a stamp."""
    offset_s = float(found.value[0])
    late = "early" if offset_s > 0 else "late"
    return f"GNSS clock {abs(offset_s):.2f} s {late} (sd {found.sigma[0]:.3f} s), corrected"
