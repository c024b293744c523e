"""The rectangle in a flat piece's edges: first of any size, to measure it; then of the board's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.edges import Edges
from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.sweep import B1
from scanloom.stages.geometry.se3 import F8

_ANGLES = 18
_REFINED = 2
_BLUR_M = 0.004
"""How unevenly an edge is hit beyond the distance of two rays."""
_LOOSE = 0.5
"""Sizes nothing is seen of are guessed to this share, so that the fit has an answer."""
_UNSEEN = 0.15
"""Sizes less certain than this share count as not seen."""


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in the plane of a patch."""

    centre: F8
    """(2,) in the axes of the plane, m."""
    angle: float
    """Of its first side from the plane's first axis, rad."""
    size: F8
    """(2,) m."""
    size_sigma: F8
    cost: float


def plane_axes(patch: Patch) -> F8:
    """(3, 3) columns: two axes in the plane, the second as upright as can be, and the normal towards the sensor."""
    up = np.array([0.0, 0.0, 1.0]) if abs(patch.normal[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    first = np.cross(up, patch.normal)
    first /= np.linalg.norm(first)
    return np.column_stack((first, np.cross(patch.normal, first), patch.normal))


def on_plane(patch: Patch, axes: F8, directions: F8) -> F8:
    """Where rays meet the plane (n, 2), from the foot of the sensor's perpendicular; far off for rays that pass it."""
    slope = np.minimum(directions @ patch.normal, -1e-2)
    return directions @ axes[:, :2] * (-patch.distance_m / slope)[:, None]


def outside_by(points: F8, centre: F8, angle: float, half: F8) -> F8:
    """Signed distance (n,) of points (n, 2) from a rectangle's outline, m; positive outside."""
    c, s = np.cos(angle), np.sin(angle)
    off = points - centre
    d = np.abs(np.column_stack((c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]))) - half
    out: F8 = np.where((d > 0).all(axis=1), np.hypot(d[:, 0], d[:, 1]), d.max(axis=1))
    return out


def measured(patch: Patch, edges: Edges) -> Rectangle | None:
    """The rectangle that fits the edges best, whatever its size; None with fewer than six edges along beams."""
    from scipy.optimize import least_squares

    if (~edges.across).sum() < 6:
        return None
    axes = plane_axes(patch)
    on, off = on_plane(patch, axes, edges.on), on_plane(patch, axes, edges.off)
    middle = (on + off) / 2
    root = np.sqrt(edges.weight)

    def residuals(x: F8) -> F8:
        half = np.abs(x[3:])
        a, b = outside_by(on, x[:2], x[2], half), outside_by(off, x[:2], x[2], half)
        m = outside_by(middle, x[:2], x[2], half)
        sigma = np.sqrt((a - b) ** 2 / 12 + _BLUR_M**2)
        return np.concatenate((root * m / sigma, (half - guess) / (_LOOSE * guess)))

    best = None
    for start in _starts(middle[~edges.across]):
        guess = start[3:].copy()
        fit = least_squares(residuals, start, loss="cauchy", f_scale=2.0, max_nfev=20)
        if best is None or fit.cost < best.cost:
            best = fit
    if best is None:
        return None
    spread = np.linalg.pinv(best.jac.T @ best.jac)
    sigma = 2 * np.sqrt(np.maximum(np.diag(spread)[3:], 0))
    return Rectangle(best.x[:2], float(best.x[2]), 2 * np.abs(best.x[3:]), sigma, float(best.cost))


def _starts(points: F8) -> list[F8]:
    """Rectangles around the points at several angles, those whose sides are nearest to the points first."""
    found = []
    for angle in np.arange(_ANGLES) * (np.pi / 2 / _ANGLES):
        c, s = np.cos(angle), np.sin(angle)
        turned = points @ np.array([[c, -s], [s, c]])
        low, high = np.percentile(turned, 4, axis=0), np.percentile(turned, 96, axis=0)
        centre = np.array([[c, -s], [s, c]]) @ ((low + high) / 2)
        half = np.maximum((high - low) / 2, 0.02)
        off = np.abs(outside_by(points, centre, float(angle), half))
        found.append((np.minimum(off, 0.1).mean(), np.array([*centre, angle, *half])))
    return [start for _, start in sorted(found, key=lambda pair: pair[0])[:_REFINED]]


def fits(rectangle: Rectangle, board: Board, share: float) -> list[bool]:
    """Whether the first side may be the board's first, and whether it may be its second."""
    wanted = np.asarray(board.board_m)
    return [_alike(rectangle, size, share) for size in (wanted, wanted[::-1])]


def _alike(rectangle: Rectangle, size: F8, share: float) -> bool:
    seen = rectangle.size_sigma < _UNSEEN * size
    off = rectangle.size - size
    slack = share * size + np.where(seen, 2 * np.minimum(rectangle.size_sigma, share / 2 * size), np.inf)
    return bool((np.abs(off) <= slack).all() and seen.any())


def seen_sides(rectangle: Rectangle, board: Board) -> B1:
    """Which of both sizes were measured and not guessed."""
    seen: B1 = rectangle.size_sigma < _UNSEEN * np.mean(board.board_m)
    return seen
