"""Which fixes agree with the motion odometry saw (methods 1.9, third gate).

Between two fixes some tens of metres apart GNSS and odometry must tell the same length, and their headings must differ by
what they differ by elsewhere nearby. That turns odometry, stretch by stretch, into the axes of GNSS; against it the
residual of honest fixes changes slowly. The longest chain of fixes without a jump is kept: a single lie is left out, and
so is a stretch of multipath as a whole, since the chain through it is shorter than the one around it.
Positions in the plane are complex numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]
C16 = NDArray[np.complex128]
Flags = NDArray[np.bool_]

CHORD_SIGMAS = 30.0
"""Length of a chord in standard deviations of a fix: its heading is good to some 3 deg."""
CHORD_M = (20.0, 150.0)
STATION_M = 20.0
TURN_RAD, TURN_RAD_M = np.radians(6.0), np.radians(0.05)
"""Most that the heading of odometry drifts: always, and per metre."""
BETTER = 3.0
"""How much less than the receiver states its fixes may be taken to scatter."""
MOST_SLACK = 0.2
"""Share of a chord that odometry may be off by and still tell its direction."""
SIGMAS = 3.5
"""Chance lies beyond once in 450 times, in the plane."""
MOST_COMPARED = 2000
"""Fixes a fix is compared with; bounds the time for a vehicle that stands for hours."""
MOST_CHORDS = 50
"""That say how odometry is turned at a place; of more, some are asked."""
ROUNDS = 3


def agreeing(
    p: C16, q: C16, way_m: F8, slack_m: F8, sigma_m: F8, tolerance_m: float, farthest_m: float
) -> Flags:
    """Fixes (n,) of the longest chain that odometry confirms.

    Parameters
    ----------
    p, q : (n,) antenna by odometry (levelled) and by GNSS, m.
    way_m : (n,) way driven at each fix, increasing.
    slack_m : (n,) disagreement allowed up to each fix, increasing: the drift of odometry over its way, and where no scan
        saw the motion as much as the vehicle may have moved.
    sigma_m : (n,) standard deviation the receiver states, m; less is assumed when the fixes scatter less.
    tolerance_m : disagreement always allowed.
    farthest_m : fixes further apart than this are not compared.
    """
    keep = np.ones(len(p), bool)
    if len(p) < 3:
        return keep
    for _ in range(ROUNDS):
        straight = straightened(p, q, way_m, slack_m, sigma_m, tolerance_m, keep)
        if straight is None:
            return np.zeros(len(p), bool)
        residual = q - straight
        seen = _scatter(residual[keep]) if keep.sum() > 10 else np.inf
        sigma = np.clip(seen, sigma_m / BETTER, sigma_m)
        before, keep = keep, longest_chain(residual, way_m, slack_m, sigma, tolerance_m, farthest_m)
        if np.array_equal(before, keep):
            break
    return keep


def straightened(
    p: C16, q: C16, way_m: F8, slack_m: F8, sigma_m: F8, tolerance_m: float, keep: Flags
) -> C16 | None:
    """Odometry p (n,) turned into the axes of q, stretch by stretch; None when no two fixes tell a heading.

    The turn at a place is the median of what chords nearby say whose length agrees; between places that disagree with
    most others, since GNSS itself turns there, it is interpolated.
    """
    chord_m = float(np.clip(CHORD_SIGMAS * np.median(sigma_m), *CHORD_M))
    chord_m = min(chord_m, 0.5 * float(way_m[-1] - way_m[0]))
    middle, turn = _chord_turns(p, q, way_m, slack_m, sigma_m, tolerance_m, keep, chord_m)
    if not len(middle):
        return None
    station = np.arange(way_m[0], way_m[-1] + STATION_M, STATION_M)
    half = max(3.0 * chord_m, 3.0 * float(np.median(np.diff(np.unique(middle)))) if len(middle) > 1 else 0.0)
    there = np.array([((middle > s - half) & (middle < s + half)).sum() > 0 for s in station])
    local = np.array([_middle_turn(turn[np.abs(middle - s) < half]) for s in station[there]])
    station = station[there]
    sure = _turn_chain(local, station)
    angle = np.unwrap(np.angle(local[sure]))
    step = np.diff(p, prepend=p[0])
    between = 0.5 * (way_m + np.concatenate((way_m[:1], way_m[:-1])))
    return np.asarray(np.cumsum(step * np.exp(1j * np.interp(between, station[sure], angle))))


def longest_chain(
    residual: C16, way_m: F8, slack_m: F8, sigma_m: F8, tolerance_m: float, farthest_m: float
) -> Flags:
    """The longest chain of fixes (n,) between neighbours of which the residual does not jump.

    It may change by a fixed tolerance, by 3.5 sigma and by the slack between them. Fixes further apart than
    `farthest_m` are not compared: there the chain goes on anew. Dynamic programming.
    """
    far = np.searchsorted(way_m, way_m - farthest_m)
    first = np.maximum(far, np.arange(len(residual)) - MOST_COMPARED)
    x, y = np.ascontiguousarray(residual.real), np.ascontiguousarray(residual.imag)
    slack, sigma = np.ascontiguousarray(slack_m, np.float64), np.ascontiguousarray(sigma_m, np.float64)
    return _chain(x, y, slack, sigma, far.astype(np.int64), first.astype(np.int64), float(tolerance_m))


@kernel
def _chain(x: F8, y: F8, slack_m: F8, sigma_m: F8, far: I8, first: I8, tolerance_m: float) -> Flags:
    """Fixes before `far` are not compared, those from `first` on are."""
    n = len(x)
    length, previous = np.ones(n, np.int64), np.full(n, -1, np.int64)
    ends = np.zeros(n, np.int64)
    for k in range(1, n):
        best = 0
        for a in range(k - 1, first[k] - 1, -1):
            if length[a] > best:
                sigma = np.sqrt(sigma_m[a] ** 2 + sigma_m[k] ** 2)
                allowed = tolerance_m + SIGMAS * sigma + slack_m[k] - slack_m[a]
                if np.sqrt((x[k] - x[a]) ** 2 + (y[k] - y[a]) ** 2) <= allowed:
                    best = length[a]
                    length[k], previous[k] = best + 1, a
        if far[k] > 0 and length[ends[far[k] - 1]] >= length[k]:
            previous[k] = ends[far[k] - 1]
            length[k] = length[previous[k]] + 1
        ends[k] = k if length[k] > length[ends[k - 1]] else ends[k - 1]
    keep = np.zeros(n, np.bool_)
    k = ends[n - 1] if n else -1
    while k >= 0:
        keep[k] = True
        k = previous[k]
    return keep


def _chord_turns(
    p: C16, q: C16, way_m: F8, slack_m: F8, sigma_m: F8, tolerance_m: float, keep: Flags, chord_m: float
) -> tuple[F8, C16]:
    """Way at the middle of each chord between kept fixes whose length agrees, and its turn as a unit number."""
    rows = np.flatnonzero(keep)
    rows = rows[np.unique(np.floor(way_m[rows]), return_index=True)[1]]
    after = np.searchsorted(way_m[rows], way_m[rows] + chord_m)
    i, j = rows[after < len(rows)], rows[after[after < len(rows)]]
    a, b = p[j] - p[i], q[j] - q[i]
    slack = slack_m[j] - slack_m[i]
    allowed = tolerance_m + SIGMAS * np.hypot(sigma_m[i], sigma_m[j]) + slack
    long = np.minimum(np.abs(a), np.abs(b)) > 0.3 * chord_m
    fits = long & (slack < MOST_SLACK * chord_m) & (np.abs(np.abs(a) - np.abs(b)) <= allowed)
    turn = (b * np.conj(a))[fits]
    return 0.5 * (way_m[i] + way_m[j])[fits], turn / np.abs(turn)


def _middle_turn(turn: C16) -> complex:
    """Geometric median of unit numbers, back on the circle (Weiszfeld)."""
    turn = turn[:: max(1, len(turn) // MOST_CHORDS)]
    centre = turn.mean()
    for _ in range(20):
        w = 1.0 / np.maximum(np.abs(turn - centre), 1e-3)
        last, centre = centre, (w * turn).sum() / w.sum()
        if abs(centre - last) < 1e-4:
            break
    return complex(centre / abs(centre)) if abs(centre) > 0 else complex(1.0)


def _turn_chain(turn: C16, station_m: F8) -> Flags:
    whole = station_m[-1] - station_m[0] + 1.0
    return longest_chain(turn, station_m, TURN_RAD_M * station_m, np.zeros(len(turn)), float(TURN_RAD), whole)


def _scatter(residual: C16) -> float:
    """Standard deviation per axis that the change from fix to fix has, whatever a third of them does."""
    change = np.abs(np.diff(residual))
    return float(np.median(change) / 1.1774 / np.sqrt(2.0))
