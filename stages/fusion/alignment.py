"""Where a levelled trajectory stands in the world: heading and translation from GNSS positions, robustly."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from scanloom.stages.fusion.drives import I8
from scanloom.stages.geometry.se3 import F8, pose, so3_exp

MOST_ANCHORS = 40


@dataclass(frozen=True)
class Alignment:
    """Pose (4, 4) of a levelled frame in `world`, and how well its heading is known."""

    T_world_level: F8
    inliers: np.ndarray
    heading_sigma_rad: float


def align_level(level: F8, world: F8, sigma_m: F8, travelled_m: F8, drift: float) -> Alignment | None:
    """Heading and translation that take positions `level` (n, 3) to `world` (n, 3), by consensus.

    Every pair among some forty positions spread over the log proposes a heading and a translation; the proposal that
    most positions agree with wins and is refined by least squares over them. A position agrees when it lies within
    3 sigma plus `drift` times the path to the nearer position of the pair. None when no pair is far enough apart.

    Parameters
    ----------
    sigma_m : (n,) horizontal standard deviation of each position.
    travelled_m : (n,) path length at each position.
    """
    anchors = np.unique(np.linspace(0, len(level) - 1, min(MOST_ANCHORS, len(level))).astype(np.int64))
    best: np.ndarray | None = None
    for a, b in combinations(anchors, 2):
        if np.linalg.norm(world[b, :2] - world[a, :2]) < 4.0 * np.hypot(sigma_m[a], sigma_m[b]):
            continue
        T = _from_pair(level, world, a, b)
        near = np.minimum(np.abs(travelled_m - travelled_m[a]), np.abs(travelled_m - travelled_m[b]))
        agree = _horizontal_error(T, level, world) < 3.0 * sigma_m + drift * near
        if best is None or agree.sum() > best.sum():
            best = agree
    if best is None or best.sum() < 2:
        return None
    T = fit_level(level[best], world[best], 1.0 / sigma_m[best] ** 2)
    return Alignment(T, best, _heading_sigma(level[best], sigma_m[best]))


def fit_level(level: F8, world: F8, weight: F8) -> F8:
    """Weighted least-squares heading and translation (4, 4); closed form (Umeyama, in the plane)."""
    w = weight / weight.sum()
    a, b = level - w @ level, world - w @ world
    sine = np.sum(w * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    cosine = np.sum(w * (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    R = so3_exp([0.0, 0.0, np.arctan2(sine, cosine)])
    return pose(R, w @ world - R @ (w @ level))


def _from_pair(level: F8, world: F8, a: int, b: int) -> F8:
    rows: I8 = np.array([a, b])
    return fit_level(level[rows], world[rows], np.ones(2))


def _horizontal_error(T: F8, level: F8, world: F8) -> F8:
    moved = level @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.linalg.norm((moved - world)[:, :2], axis=1))


def _heading_sigma(level: F8, sigma_m: F8) -> float:
    """Standard deviation of a heading fitted to independent positions: 1 / sqrt(sum r^2 / sigma^2)."""
    w = 1.0 / sigma_m**2
    centre = (w / w.sum()) @ level
    information = float(np.sum(w * np.sum((level - centre)[:, :2] ** 2, axis=1)))
    return float(1.0 / np.sqrt(max(information, 1e-12)))
