"""Coarse alignment of two submaps: correlation of their upright structure seen from above, for several headings.

Correlative matching over x, y (exhaustive, by FFT) finds a translation far outside the basin of a local method
(methods 1.11). z comes from the heights of the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from scanloom.stages.loops.submaps import Submap

CELL_M = 0.75
CELLS = 256
HALF_WIDTH_M = 44.0
LOWEST_M, HIGHEST_M = 0.4, 8.0
PEAKS_PER_HEADING = 3


@dataclass(frozen=True)
class Hypothesis:
    """A proposed pose (4, 4) of level frame j in level frame i, and the share of j's cells that hit cells of i."""

    T_i_j: F8
    score: float


def hypotheses(i: Submap, j: Submap, headings_rad: F8, reach_m: float, most: int) -> list[Hypothesis]:
    """The best poses of j in i, each at least 1.5 m or 5 degrees from better ones. Translations reach `reach_m`."""
    fixed = np.fft.rfft2(_widened(_picture(_structure(i))))
    moving = _structure(j)
    window = int(reach_m / CELL_M)
    z = i.ground_z_m - j.ground_z_m
    z = float(z) if np.isfinite(z) else 0.0
    found = []
    for yaw in headings_rad:
        R = so3_exp([0.0, 0.0, yaw])
        picture = _picture(moving @ R[:2, :2].T)
        total = picture.sum()
        if total == 0:
            continue
        score = np.fft.irfft2(fixed * np.conj(np.fft.rfft2(picture)), s=(CELLS, CELLS)) / total
        for u, v in _peaks(score, window):
            T = pose(R, np.array([u * CELL_M, v * CELL_M, z]))
            found.append(Hypothesis(T, float(score[u % CELLS, v % CELLS])))
    found.sort(key=lambda h: -h.score)
    return _distinct(found, most)


def _structure(submap: Submap) -> F8:
    """x, y (n, 2) of points that are no ground and stand at the height of walls, poles and trunks."""
    z = submap.points[:, 2] - (submap.ground_z_m if np.isfinite(submap.ground_z_m) else -1.8)
    p = submap.points[~submap.ground & (z > LOWEST_M) & (z < HIGHEST_M)]
    return p[:, :2]


def _picture(xy: F8) -> F8:
    """Cells (256, 256) that hold structure; the origin is in the middle of the filled part."""
    out = np.zeros((CELLS, CELLS))
    inside = (np.abs(xy) < HALF_WIDTH_M).all(axis=1)
    cell = np.floor(xy[inside] / CELL_M).astype(np.int64) % CELLS
    out[cell[:, 0], cell[:, 1]] = 1.0
    return out


def _widened(picture: F8) -> F8:
    """Cells next to structure count half: the true offset lies between cells."""
    out = picture.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            out = np.maximum(out, 0.5 * np.roll(picture, step, axis))
    return np.asarray(out)


def _peaks(score: F8, window: int) -> list[tuple[int, int]]:
    """The best offsets in cells within the window, three cells apart."""
    steps = np.arange(-window, window + 1)
    part = score[np.ix_(steps % CELLS, steps % CELLS)].copy()
    out = []
    for _ in range(PEAKS_PER_HEADING):
        u, v = divmod(int(np.argmax(part)), part.shape[1])
        out.append((int(steps[u]), int(steps[v])))
        part[max(u - 3, 0) : u + 4, max(v - 3, 0) : v + 4] = -1.0
    return out


def _distinct(found: list[Hypothesis], most: int) -> list[Hypothesis]:
    kept: list[Hypothesis] = []
    for h in found:
        if len(kept) == most:
            break
        if all(_apart(h.T_i_j, k.T_i_j) for k in kept):
            kept.append(h)
    return kept


def _apart(a: F8, b: F8) -> bool:
    turn = np.arctan2((a[:2, :2].T @ b[:2, :2])[1, 0], (a[:2, :2].T @ b[:2, :2])[0, 0])
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) > 1.5 or abs(turn) > np.radians(5.0))
