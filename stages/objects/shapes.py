"""The box that a cluster shows of itself: its direction, and which of its sides were really seen.

A side is seen where it faces the LiDAR, or where the side beside it ends in front of free space. An end that something
nearer hides, or that lies behind the object itself, says nothing of where the box ends: a wall seen through a gap has no
ends, and a car that shows more and more of itself does not move.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects.virtual_scan import BINS, bin_of

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

CLOSEST_M = 0.05
MOST_POINTS = 120
"""A direction is sought with so many points at most."""
FACING_M = 0.08
"""Standard deviation of a side that faces the LiDAR."""
GRAZING = 0.17
"""A side seen at less than this sine of an angle does not show where it ends."""
NEARER_M = 0.5
OUTSIDE = (2, 7)
"""Bins beyond an end in which what hides it is looked for."""

LOW_U, HIGH_U, LOW_V, HIGH_V = 0, 1, 2, 3


@kernel
def direction(points: F4, around: float, reach: float, steps: int) -> float:
    """Yaw, rad, within `reach` of `around`, along which the points lie closest to two sides of a box (Zhang et al. 2017)."""
    every = 1 + (len(points) - 1) // MOST_POINTS
    best, found = -1.0, around
    for k in range(-steps, steps + 1):
        yaw = around + reach * k / steps
        c, s = np.cos(yaw), np.sin(yaw)
        lu, hu, lv, hv = np.inf, -np.inf, np.inf, -np.inf
        for n in range(0, len(points), every):
            u, v = c * points[n, 0] + s * points[n, 1], c * points[n, 1] - s * points[n, 0]
            lu, hu, lv, hv = min(lu, u), max(hu, u), min(lv, v), max(hv, v)
        score = 0.0
        for n in range(0, len(points), every):
            u, v = c * points[n, 0] + s * points[n, 1], c * points[n, 1] - s * points[n, 0]
            du = u - lu if abs(lu) < abs(hu) else hu - u
            dv = v - lv if abs(lv) < abs(hv) else hv - v
            score += 1.0 / max(min(du, dv), CLOSEST_M)
        if score > best:
            best, found = score, yaw
    return found


@kernel
def bounds(points: F4, yaw: float) -> F8:
    """Lowest and highest u, lowest and highest v (4,) of the points along a yaw, m."""
    c, s = np.cos(yaw), np.sin(yaw)
    out = np.array([np.inf, -np.inf, np.inf, -np.inf])
    for n in range(len(points)):
        u, v = c * points[n, 0] + s * points[n, 1], c * points[n, 1] - s * points[n, 0]
        out[LOW_U], out[HIGH_U] = min(out[LOW_U], u), max(out[HIGH_U], u)
        out[LOW_V], out[HIGH_V] = min(out[LOW_V], v), max(out[HIGH_V], v)
    return out


@kernel
def spreads(points: F4, yaw: float, sides: F8, starts: I4, returns: F4, step_rad: float) -> F8:
    """Standard deviations (4,) of the sides of a box in `sides`, m; infinite for those that were not seen."""
    out = np.full(4, np.inf)
    near_u = min(abs(sides[LOW_U]), abs(sides[HIGH_U])) if sides[LOW_U] * sides[HIGH_U] > 0.0 else 0.0
    near_v = min(abs(sides[LOW_V]), abs(sides[HIGH_V])) if sides[LOW_V] * sides[HIGH_V] > 0.0 else 0.0
    r = np.hypot(0.5 * (sides[LOW_U] + sides[HIGH_U]), 0.5 * (sides[LOW_V] + sides[HIGH_V]))
    grazing_u, grazing_v = near_u / max(r, 0.1), near_v / max(r, 0.1)
    if grazing_v > GRAZING:  # a side along u is seen, and so are its ends
        out[LOW_U] = out[HIGH_U] = FACING_M + 0.5 * min(r * step_rad / grazing_v, 2.0)
    if grazing_u > GRAZING:
        out[LOW_V] = out[HIGH_V] = FACING_M + 0.5 * min(r * step_rad / grazing_u, 2.0)
    if near_u > 0.0:
        out[LOW_U if sides[LOW_U] > 0.0 else HIGH_U] = FACING_M
    if near_v > 0.0:
        out[LOW_V if sides[LOW_V] > 0.0 else HIGH_V] = FACING_M
    _hidden(points, yaw, sides, starts, returns, out)
    return out


@kernel
def _hidden(points: F4, yaw: float, sides: F8, starts: I4, returns: F4, out: F8) -> None:
    """Forget the sides at an outermost point that something nearer hides."""
    middle = np.arctan2(np.float64(points[0, 1]), np.float64(points[0, 0]))
    least, most, first, last = np.inf, -np.inf, 0, 0
    low, high = np.inf, -np.inf
    for n in range(len(points)):
        turn = np.arctan2(points[n, 1], points[n, 0]) - middle
        turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
        if turn < least:
            least, first = turn, n
        if turn > most:
            most, last = turn, n
        low, high = min(low, points[n, 2]), max(high, points[n, 2])
    c, s = np.cos(yaw), np.sin(yaw)
    for outward, n in ((-1, first), (1, last)):
        x, y = np.float64(points[n, 0]), np.float64(points[n, 1])
        if not _occluder(np.hypot(x, y), np.arctan2(y, x), outward, low, high, starts, returns):
            continue
        u, v = c * x + s * y, c * y - s * x
        for k, off in ((0, u - sides[0]), (1, sides[1] - u), (2, v - sides[2]), (3, sides[3] - v)):
            if off < 0.4:
                out[k] = np.inf


@kernel
def _occluder(
    r: float, bearing: float, outward: int, low: float, high: float, starts: I4, returns: F4
) -> bool:
    """Whether rays just beyond an end meet something nearer, at a height that would hide what goes on there."""
    at = bin_of(bearing)
    for step in range(OUTSIDE[0], OUTSIDE[1]):
        b = (at + outward * step) % BINS
        for k in range(starts[b], starts[b + 1]):
            far = np.float64(returns[k, 0])
            if far < r - NEARER_M and low - 0.1 <= returns[k, 1] * (r / far) <= high + 0.1:
                return True
    return False
