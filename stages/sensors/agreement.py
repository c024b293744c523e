"""How well a sensor's readings and the motion between scans agree, over all time offsets and axes that may be.

Both are means over the same intervals. The correlation of the two, each without its own mean so that a constant bias
does not matter, is looked at for every offset; its peak gives the offset, the slope there the unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8

LAG_STEP_S = 0.01
FINE_STEP_S, FINE_STEPS = 0.001, 15
STRAY = 4.0
"""Pairs whose residual is this many times the typical one are wrong registrations, or slip."""
CORRELATED = 2.0
"""Residuals of neighbouring pairs are not independent: stated deviations are wider by this."""
LEAST_PAIRS = 12
HOPELESS = 0.8
LONGEST_GAP_S = 0.3


def seconds(stamp_ns: NDArray[np.int64]) -> F8:
    return np.asarray(stamp_ns, np.float64) * 1e-9


@dataclass(frozen=True)
class Seen:
    """Motion between scans: values (m, c), means over the intervals from `start_s` to `end_s` (m,)."""

    start_s: F8
    end_s: F8
    value: F8

    def take(self, rows: NDArray[np.bool_]) -> Seen:
        return Seen(self.start_s[rows], self.end_s[rows], self.value[rows])

    def __len__(self) -> int:
        return len(self.value)


@dataclass(frozen=True)
class Readings:
    """A sensor: values (n, c) at increasing times (n,), s."""

    time_s: F8
    value: F8

    @classmethod
    def of(cls, stamp_ns: NDArray[np.int64], value: F8) -> Readings:
        """Rows (n,), (n, c) that are numbers, by increasing time."""
        good = np.isfinite(value).all(axis=1)
        time_ns, first = np.unique(stamp_ns[good], return_index=True)
        return cls(seconds(time_ns), value[good][first])

    def mean_over(self, start_s: F8, end_s: F8) -> F8:
        """Means (..., c) over intervals, of the readings joined by straight lines."""
        total = self._integral(end_s) - self._integral(start_s)
        mean: F8 = total / (end_s - start_s)[..., None]
        return mean

    def _integral(self, at_s: F8) -> F8:
        step = np.diff(self.time_s)[:, None]
        parts = 0.5 * step * (self.value[1:] + self.value[:-1])
        sums = np.concatenate((np.zeros((1, self.value.shape[1])), np.cumsum(parts, axis=0)))
        i = np.clip(np.searchsorted(self.time_s, at_s, side="right") - 1, 0, len(step) - 1)
        into = (at_s - self.time_s[i])[..., None]
        slope = (self.value[i + 1] - self.value[i]) / step[i]
        integral: F8 = sums[i] + into * (self.value[i] + 0.5 * slope * into)
        return integral

    def covers(self, start_s: F8, end_s: F8) -> NDArray[np.bool_]:
        """Whether there are readings from `start_s` to `end_s` without a long gap."""
        if len(self.time_s) < 2:
            return np.zeros(len(start_s), bool)
        gaps = np.concatenate(([0], np.cumsum(np.diff(self.time_s) > LONGEST_GAP_S)))
        i = np.searchsorted(self.time_s, start_s, side="right") - 1
        j = np.searchsorted(self.time_s, end_s)
        inside = (i >= 0) & (j < len(self.time_s))
        i, j = np.clip(i, 0, len(gaps) - 1), np.clip(j, 0, len(gaps) - 1)
        covered: NDArray[np.bool_] = inside & (gaps[i] == gaps[j])
        return covered


@dataclass(frozen=True)
class Agreement:
    """seen(t) = slope * axes * readings(t + lag) + constant."""

    axes: F8
    lag_s: float
    lag_std_s: float
    correlation: float
    slope: float
    slope_std: float
    constant: F8
    noise: float
    """Standard deviation of one component of the residual."""
    excitation: float
    """Root mean square of what is seen, without its mean."""
    pairs: int


def agree(
    seen: Seen, readings: Readings, candidates: F8, max_lag_s: float, *, biased: bool = True
) -> list[Agreement]:
    """The best agreement for each of the axes to try (k, c, c), each with its own time offset; none without readings.

    biased : the readings may be off by a constant. Axes that are far from fitting, other than the first, are left out.
    """
    usable = seen.take(readings.covers(seen.start_s - max_lag_s, seen.end_s + max_lag_s))
    if len(usable) < LEAST_PAIRS:
        return []
    steps = round(max_lag_s / LAG_STEP_S)
    lags = np.asarray(np.arange(-steps, steps + 1) * LAG_STEP_S, np.float64)
    score = _correlations(usable, readings, candidates, lags, biased)
    return [
        _refined(usable, readings, axes, float(lags[np.argmax(score[:, k])]), max_lag_s, biased)
        for k, axes in enumerate(candidates)
        if k == 0 or score[:, k].max() > HOPELESS
    ]


def _correlations(seen: Seen, readings: Readings, candidates: F8, lags: F8, biased: bool) -> F8:
    """Correlation (lags, candidates)."""
    X = seen.value
    G = readings.mean_over(lags[:, None] + seen.start_s, lags[:, None] + seen.end_s)
    if biased:
        X, G = X - X.mean(axis=0), G - G.mean(axis=1, keepdims=True)
    cross = np.einsum("ni,lnj->lij", X, G)
    norm = np.linalg.norm(X) * np.linalg.norm(G, axis=(1, 2))
    score: F8 = np.einsum("kij,lij->lk", candidates, cross) / np.maximum(norm, 1e-12)[:, None]
    return score


def _refined(
    seen: Seen, readings: Readings, axes: F8, lag_s: float, max_lag_s: float, biased: bool
) -> Agreement:
    """Offset to a fraction of a millisecond by a parabola through the peak; stray pairs left out."""
    for last in (False, True):
        near = lag_s + np.arange(-FINE_STEPS, FINE_STEPS + 1) * FINE_STEP_S
        score = _correlations(seen, readings, axes[None], np.clip(near, -max_lag_s, max_lag_s), biased)[:, 0]
        top = int(np.clip(np.argmax(score), 1, len(near) - 2))
        a, b, c = score[top - 1], score[top], score[top + 1]
        bend = a - 2 * b + c
        lag_s = float(near[top] + (0.5 * FINE_STEP_S * (a - c) / bend if bend < 0 else 0.0))
        lag_s = float(np.clip(lag_s, -max_lag_s, max_lag_s))
        found, residual = _fit(seen, readings, axes, lag_s, biased)
        size = np.linalg.norm(residual, axis=1)
        good = size <= STRAY * np.median(size)
        if last or good.all() or good.sum() < LEAST_PAIRS:
            break
        seen = seen.take(good)
    return found


def _fit(seen: Seen, readings: Readings, axes: F8, lag_s: float, biased: bool) -> tuple[Agreement, F8]:
    """Least squares of slope, small change of the offset, and constants, for their deviations."""

    def told(later_s: float) -> F8:
        at = lag_s + later_s
        turned: F8 = readings.mean_over(seen.start_s + at, seen.end_s + at) @ axes.T
        return turned

    X, G = seen.value, told(0.0)
    change = (told(LAG_STEP_S) - told(-LAG_STEP_S)) / (2 * LAG_STEP_S)
    X0, G0, change0 = (M - M.mean(axis=0) for M in (X, G, change))
    A, B, C = (X0, G0, change0) if biased else (X, G, change)
    slope = float(np.sum(A * B)) / max(float(np.sum(B**2)), 1e-18)
    residual = A - slope * B
    noise = float(np.sqrt(np.sum(residual**2) / max(residual.size - 3, 1)))
    design = np.column_stack((B.ravel(), slope * C.ravel()))
    spread = CORRELATED * noise * np.sqrt(np.diag(np.linalg.pinv(design.T @ design)))
    norm = float(np.linalg.norm(X0) * np.linalg.norm(G0))
    found = Agreement(
        axes=axes,
        lag_s=lag_s,
        lag_std_s=float(spread[1]),
        correlation=float(np.sum(X0 * G0)) / max(norm, 1e-12),
        slope=slope,
        slope_std=float(spread[0]),
        constant=X.mean(axis=0) - slope * G.mean(axis=0),
        noise=noise,
        excitation=float(np.sqrt(np.mean(np.sum(X0**2, axis=1)))),
        pairs=len(seen),
    )
    return found, residual
