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
PAIRS_AT_ONCE = 100
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
    anchors = _spread(len(level), MOST_ANCHORS)
    pair = np.array(list(combinations(anchors, 2)), np.int64).reshape(-1, 2)
    far = np.linalg.norm(world[pair[:, 1], :2] - world[pair[:, 0], :2], axis=1)
    pair = pair[far >= 4.0 * np.hypot(sigma_m[pair[:, 0]], sigma_m[pair[:, 1]])]
    votes = _votes(pair, _spread(len(level), MOST_VOTERS), level, world, sigma_m, travelled_m, drift)
    if len(votes) == 0 or votes.max() < 2:
        return None
    best = pair[np.argmax(votes)]
    T = fit_level(level[best], world[best], np.ones(2))
    inliers = _agreement(T, level, world, sigma_m, drift * _apart(travelled_m, travelled_m[best]))
    T = fit_level(level[inliers], world[inliers], 1.0 / sigma_m[inliers] ** 2)
    return Alignment(T, inliers, _heading_sigma(level[inliers], sigma_m[inliers], travelled_m[inliers]))


def _spread(count: int, most: int) -> I8:
    """Up to `most` numbers from 0 to count - 1, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.int64))


def _votes(
    pair: I8, voters: I8, level: F8, world: F8, sigma_m: F8, travelled_m: F8, drift: float
) -> NDArray[np.int64]:
    """How many voters agree with what each pair (m, 2) proposes. Positions in the plane as complex numbers."""
    p, q = level[:, 0] + 1j * level[:, 1], world[:, 0] + 1j * world[:, 1]
    votes = np.zeros(len(pair), np.int64)
    for first in range(0, len(pair), PAIRS_AT_ONCE):
        a, b = pair[first : first + PAIRS_AT_ONCE].T
        turn = (q[b] - q[a]) * np.conj(p[b] - p[a])
        turn /= np.maximum(np.abs(turn), 1e-300)
        shift = 0.5 * (q[a] + q[b] - turn * (p[a] + p[b]))
        off = np.abs(turn[:, None] * p[voters] + shift[:, None] - q[voters])
        ends = travelled_m[pair[first : first + PAIRS_AT_ONCE]]
        allowed = 3.0 * sigma_m[voters] + drift * np.array([_apart(travelled_m[voters], e) for e in ends])
        votes[first : first + PAIRS_AT_ONCE] = (off < allowed).sum(axis=1)
    return votes


def _apart(travelled_m: F8, ends_m: F8) -> F8:
    """Path from each of the places to the nearer one of two."""
    return np.asarray(np.minimum(np.abs(travelled_m - ends_m[0]), np.abs(travelled_m - ends_m[1])))


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


def _heading_sigma(level: F8, sigma_m: F8, travelled_m: F8) -> float:
    """Standard deviation of a heading fitted to independent positions: 1 / sqrt(sum r^2 / sigma^2)."""
    _, rows = np.unique(np.floor(travelled_m / INDEPENDENT_M), return_index=True)
    w = 1.0 / sigma_m[rows] ** 2
    centre = (w / w.sum()) @ level[rows]
    information = float(np.sum(w * np.sum((level[rows] - centre)[:, :2] ** 2, axis=1)))
    return float(1.0 / np.sqrt(max(information, 1e-12)))
