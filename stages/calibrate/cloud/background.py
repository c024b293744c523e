"""The scene without the board: what the clouds of several placements have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanloom.stages.calibrate.cloud.sweep import B1
from scanloom.stages.geometry.se3 import F8


def static_points(clouds: Sequence[F8], cell_m: float = 0.05) -> F8:
    """Points of the scene that most of the clouds (n, 3) of different placements have in common.

    One point for every cube that more than half of the clouds have a point in, or next to.
    """
    from scipy.spatial import cKDTree

    if not clouds:
        return np.zeros((0, 3))
    cells = [
        np.unique(np.floor(cloud[np.isfinite(cloud).all(axis=1)] / cell_m).astype(np.int64), axis=0)
        for cloud in clouds
    ]
    everything = np.unique(np.concatenate(cells), axis=0)
    hits = np.zeros(len(everything), np.int64)
    for cloud in cells:
        if len(cloud):
            near, _ = cKDTree(cloud).query(everything, distance_upper_bound=1.8)
            hits += np.isfinite(near)
    return np.asarray((everything[2 * hits > len(clouds)] + 0.5) * cell_m, np.float64)


def foreground_of(points: F8, background: F8, static_m: float) -> B1:
    """Points (n, 3) farther than `static_m` from all points (k, 3) of the background."""
    from scipy.spatial import cKDTree

    out = np.ones(len(points), np.bool_)
    good = np.isfinite(points).all(axis=1)
    if len(background) and good.any():
        near, _ = cKDTree(background).query(points[good], distance_upper_bound=static_m)
        out[good] = ~np.isfinite(near)
    return out
