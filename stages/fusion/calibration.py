"""Antenna and clock of a GNSS receiver, from the motion: both move its positions against odometry's (methods 1.9).

Over windows of about a hundred metres odometry is as good as rigid. In every window the fixes are

    q_k = t_w + R_w s (p(t_k + tau) + R(t_k + tau) a)

with a pose (R_w, t_w) of the window's own and, common to all, the clock offset tau, the antenna a and a scale s. The poses
are eliminated window by window (Schur complement), the common unknowns are found by reweighted least squares
(Geman-McClure). Their covariance takes each window as one observation (cluster-robust sandwich), since what odometry
does wrong lasts longer than a fix. Positions in the plane are complex numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]
C16 = NDArray[np.complex128]

WINDOW_M = 80.0
FIXES_IN_WINDOW = 10
LEAST_FIXES = 6
LEAST_WINDOWS = 6
MOVED_M = 0.3
MOST_WINDOWS = 300
MOST_IN_WINDOW = 40
KERNELS_M = (3.0, 3.0, 1.5, 1.5, 0.8, 0.8, 0.5, 0.5, 0.5, 0.5)
"""Least width of the kernel in each round: residuals of this size weigh a quarter."""
KERNEL_TYPICAL = 5.0
"""Width of the kernel in typical residuals: a narrower one confirms whatever it starts from."""
NEAR_M = 2.0
VELOCITY_BASE_NS = 100_000_000
COMMON = 4


@dataclass(frozen=True)
class Motion:
    """Odometry of one drive with its fixes.

    `T_level_lidar` (n, 4, 4) at `stamp_ns` (n,), z up; `fix_m` (m, 2) east and north of the fixes at `fix_ns` (m,).
    """

    stamp_ns: I8
    T_level_lidar: F8
    fix_ns: I8
    fix_m: F8

    def path_at(self, stamp_ns: I8) -> F8:
        """Way (k,) from the first scan, m."""
        step = np.linalg.norm(np.diff(self.T_level_lidar[:, :3, 3], axis=0), axis=1)
        start = self.stamp_ns[0]
        known = (self.stamp_ns - start).astype(float)
        way = np.concatenate(([0.0], np.cumsum(step)))
        return np.asarray(np.interp((stamp_ns - start).astype(float), known, way))


@dataclass(frozen=True)
class Calibration:
    """Clock offset s (to add to the stamps), antenna forward and left m (to add to the given one), scale - in this order."""

    value: F8
    covariance: F8
    windows: int
    rms_m: float
    """Of what remains of the fixes that agree, per axis."""

    @property
    def sigma(self) -> F8:
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class _Window:
    """Fixes of one window against odometry: antenna (k,) in the level frame, its derivatives (k, 4), positions (k,)."""

    predicted: C16
    columns: C16
    measured: C16


@dataclass(frozen=True)
class _Reduced:
    """One window's share of the normal equations, its own pose eliminated."""

    pose: tuple[complex, complex]
    information: F8
    score: F8
    square: float
    weight: float
    typical_m: float
    """Median distance of its fixes."""


def calibrate(motions: Sequence[Motion], antenna_m: F8, base: F8, start: F8, sigma: F8) -> Calibration | None:
    """Common unknowns from all windows of all drives; None when there are too few windows.

    Parameters
    ----------
    antenna_m : (3,) antenna in the LiDAR frame as far as known.
    base : (3, 2) forward and left of the vehicle in the LiDAR frame.
    start, sigma : (4,) what is known before of the unknowns, and how well; iteration begins there.
    """
    places = [_windows(motion, start[0]) for motion in motions]
    x, prior = start.copy(), np.diag(1.0 / sigma**2)
    poses: dict[tuple[int, int], tuple[complex, complex]] = {}
    found: list[_Reduced] = []
    for least_m in KERNELS_M:
        kernel_m = max(least_m, KERNEL_TYPICAL * float(np.median([r.typical_m for r in found] or [0.0])))
        found = []
        for m, (motion, rows) in enumerate(zip(motions, places, strict=True)):
            for k, window in enumerate(_filled(motion, rows, x, antenna_m, base)):
                if len(window.measured) >= LEAST_FIXES:
                    reduced = _reduced(window, poses.get((m, k)) or _first_pose(window), kernel_m)
                    poses[m, k] = reduced.pose
                    found.append(reduced)
        if len(found) < LEAST_WINDOWS:
            return None
        variance = sum(r.square for r in found) / sum(r.weight for r in found) + 1e-8
        H = prior + sum(r.information for r in found) / variance
        x = x + np.linalg.solve(H, prior @ (start - x) + sum(r.score for r in found) / variance)
    return Calibration(x, _covariance(H, prior, found, variance), len(found), float(np.sqrt(variance)))


def _covariance(H: F8, prior: F8, found: Sequence[_Reduced], variance: float) -> F8:
    """Sandwich over windows, each taken as if left out (jackknife, CR3), and at least what H itself says.

    The windows that tell most, with turns and changes of speed, are few; what remains of them after the fit says too little.
    """
    spread = prior.copy()
    for r in found:
        rest = np.eye(COMMON) - np.linalg.solve(H, r.information / variance).T
        score = np.linalg.solve(rest, r.score / variance)
        spread += np.outer(score, score)
    covariance = np.linalg.solve(H, np.linalg.solve(H, spread).T)
    least = np.diag(np.linalg.inv(H))
    scale = np.sqrt(np.maximum(least / np.diag(covariance), 1.0))
    return np.asarray(covariance * np.outer(scale, scale))


def _windows(motion: Motion, offset_s: float) -> list[I8]:
    """Rows of the fixes of each window, some of them where there are many."""
    way = motion.path_at(motion.fix_ns + round(offset_s * 1e9))
    steps = np.diff(way)
    step_m = float(np.median(steps[steps > MOVED_M])) if (steps > MOVED_M).any() else 0.0
    number = np.floor(way / max(WINDOW_M, FIXES_IN_WINDOW * step_m)).astype(np.int64)
    found = []
    for n in np.unique(number):
        rows = np.flatnonzero(number == n)
        if len(rows) >= LEAST_FIXES:
            found.append(rows[_spread(len(rows), MOST_IN_WINDOW)].astype(np.int64))
    return [found[k] for k in _spread(len(found), MOST_WINDOWS)]


def _spread(count: int, most: int) -> I8:
    """Up to `most` numbers from 0 to count - 1, evenly spread."""
    return (
        np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.int64))
        if count
        else np.zeros(0, np.int64)
    )


def _filled(motion: Motion, places: Sequence[I8], x: F8, antenna_m: F8, base: F8) -> list[_Window]:
    """The windows at common unknowns x (4,), without the fixes whose time no scan covers."""
    if not places:
        return []
    rows = np.concatenate(places)
    number = np.repeat(np.arange(len(places)), [len(r) for r in places])
    stamp = motion.fix_ns[rows] + round(x[0] * 1e9)
    known = (stamp >= motion.stamp_ns[0]) & (stamp <= motion.stamp_ns[-1])
    rows, stamp, number = rows[known], stamp[known], number[known]
    a = antenna_m + base @ x[1:3]

    def antenna_at(at_ns: I8) -> tuple[C16, F8]:
        T = interpolate_poses(motion.stamp_ns, motion.T_level_lidar, at_ns)
        return _plane(T[:, :3, :3] @ a + T[:, :3, 3]), T[:, :3, :3]

    here, R = antenna_at(stamp)
    after, before = (antenna_at(stamp + d)[0] for d in (VELOCITY_BASE_NS, -VELOCITY_BASE_NS))
    speed = (after - before) / (2e-9 * VELOCITY_BASE_NS)
    here -= _means(here, number, len(places))
    columns = np.column_stack(
        (x[3] * speed, x[3] * _plane(R @ base[:, 0]), x[3] * _plane(R @ base[:, 1]), here)
    )
    measured = motion.fix_m[rows] @ np.array([1.0, 1.0j])
    ends = np.searchsorted(number, np.arange(1, len(places)))
    return [
        _Window(x[3] * p, c, q)
        for p, c, q in zip(*(np.split(v, ends) for v in (here, columns, measured)), strict=True)
    ]


def _means(values: C16, number: I8, count: int) -> C16:
    """Of each value (k,) the mean of those with the same number."""
    total = np.zeros(count, complex)
    np.add.at(total, number, values)
    return np.asarray((total / np.maximum(np.bincount(number, minlength=count), 1))[number])


def _plane(points: F8) -> C16:
    return np.asarray(points[:, 0] + 1j * points[:, 1])


def _first_pose(window: _Window) -> tuple[complex, complex]:
    """Turn and shift that most fixes of the window agree with, among those that pairs of them propose."""
    p, q = window.predicted, window.measured
    i, j = np.triu_indices(len(p), 1)
    turn = (q[j] - q[i]) * np.conj(p[j] - p[i])
    turn = np.where(np.abs(turn) > 0, turn / np.maximum(np.abs(turn), 1e-300), 1.0)
    shift = 0.5 * (q[i] + q[j] - turn * (p[i] + p[j]))
    off = np.abs(turn[:, None] * p + shift[:, None] - q)
    best = int(np.argmin(np.minimum(off, NEAR_M).sum(axis=1)))
    return complex(turn[best]), complex(shift[best])


def _reduced(window: _Window, pose: tuple[complex, complex], kernel_m: float) -> _Reduced:
    """Weighted least squares over one window, linear in its pose and the common unknowns, the pose eliminated."""
    turn, shift = pose
    moved = turn * window.predicted
    residual = window.measured - moved - shift
    weight = 1.0 / (1.0 + np.abs(residual / kernel_m) ** 2) ** 2
    n = len(residual)
    own = np.column_stack((1j * moved, np.ones(n), np.full(n, 1j)))
    A = _real(np.column_stack((turn * window.columns, own)))
    w, r = np.tile(weight, 2), _real(residual[:, None])[:, 0]
    N, b = (A.T * w) @ A, (A.T * w) @ r
    c, o = slice(0, COMMON), slice(COMMON, None)
    gain = np.linalg.solve(N[o, o] + 1e-9 * np.eye(3), np.column_stack((N[o, c], b[o])))
    d = gain[:, -1]
    turned = turn * (1 + 1j * d[0]) / abs(1 + 1j * d[0])
    left = r - A[:, o] @ d
    return _Reduced(
        (turned, shift + complex(d[1], d[2])),
        N[c, c] - N[c, o] @ gain[:, :-1],
        b[c] - N[c, o] @ d,
        float(w @ left**2),
        float(max(w.sum() - 3.0, 1.0)),
        float(np.median(np.abs(residual))),
    )


def _real(values: C16) -> F8:
    """Real parts of all rows, then imaginary parts (2 k, m)."""
    return np.concatenate((values.real, values.imag))
