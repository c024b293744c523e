"""Where a levelled trajectory stands in the world: heading and translation from GNSS positions, robustly."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.fusion.drives import I8
from scanloom.stages.geometry.se3 import F8, pose, so3_exp

MOST_ANCHORS = 40
MOST_VOTERS = 1000
INDEPENDENT_M = 5.0
"""Fixes nearer to each other than this share their errors and count as one for the certainty of the heading."""


@dataclass(frozen=True)
class Alignment:
    """Pose (4, 4) of a levelled frame in `world`, and how well its heading is known."""

    T_world_level: F8
    inliers: NDArray[np.bool_]
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
    voters = np.unique(np.linspace(0, len(level) - 1, min(MOST_VOTERS, len(level))).astype(np.int64))
    best: tuple[int, F8, int, int] | None = None
    for a, b in combinations(anchors, 2):
        if np.linalg.norm(world[b, :2] - world[a, :2]) < 4.0 * np.hypot(sigma_m[a], sigma_m[b]):
            continue
        T = _from_pair(level, world, a, b)
        agree = _agreement(
            T, level[voters], world[voters], sigma_m[voters], drift * _apart(travelled_m, voters, a, b)
        )
        if best is None or agree.sum() > best[0]:
            best = int(agree.sum()), T, int(a), int(b)
    if best is None or best[0] < 2:
        return None
    every = np.arange(len(level))
    inliers = _agreement(best[1], level, world, sigma_m, drift * _apart(travelled_m, every, *best[2:]))
    T = fit_level(level[inliers], world[inliers], 1.0 / sigma_m[inliers] ** 2)
    return Alignment(T, inliers, _heading_sigma(level[inliers], sigma_m[inliers], travelled_m[inliers]))


def _apart(travelled_m: F8, rows: I8, a: int, b: int) -> F8:
    """Path from each of the rows to the nearer one of a and b."""
    at = travelled_m[rows]
    return np.asarray(np.minimum(np.abs(at - travelled_m[a]), np.abs(at - travelled_m[b])))


def _agreement(T: F8, level: F8, world: F8, sigma_m: F8, allowed_m: F8) -> NDArray[np.bool_]:
    moved = level @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.linalg.norm((moved - world)[:, :2], axis=1) < 3.0 * sigma_m + allowed_m)


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


def _heading_sigma(level: F8, sigma_m: F8, travelled_m: F8) -> float:
    """Standard deviation of a heading fitted to independent positions: 1 / sqrt(sum r^2 / sigma^2)."""
    _, rows = np.unique(np.floor(travelled_m / INDEPENDENT_M), return_index=True)
    w = 1.0 / sigma_m[rows] ** 2
    centre = (w / w.sum()) @ level[rows]
    information = float(np.sum(w * np.sum((level[rows] - centre)[:, :2] ** 2, axis=1)))
    return float(1.0 / np.sqrt(max(information, 1e-12)))
