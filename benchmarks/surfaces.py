"""How far the surfaces of one session lie from those of another in the same map."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import Piece
from scanloom.stages.geometry.se3 import F8

RADIUS_M = 0.35
NEIGHBOURS = 10
THIN_M = 0.03
"""A neighbourhood thicker than this, across, is no plane."""
FAR_M = 0.3
"""Farther from the plane than this something else stands there, on one of the days."""
MOST_PER_TILE = 4000


def plane_distances(pieces: Parts[Piece], old: str, new: str) -> F8:
    """Signed distances (n,) of points of session `new` to planes through the points of session `old` around them, m.

    A plane is fitted to at least 10 old points within 0.35 m that lie flat; points more than 0.3 m from it, which stand
    where nothing stood, are left out.
    """
    found = [np.empty(0)]
    for tile, parts in pieces.by("tile").items():
        a, b = _points(tile, parts, old), _points(tile, parts, new)
        if len(a) >= NEIGHBOURS and len(b):
            found.append(_distances(a, b[:: max(1, len(b) // MOST_PER_TILE)]))
    return np.concatenate(found)


def _points(tile: str, parts: Parts[Piece], session: str) -> F8:
    """Mean points (n, 3) of the voxels of a session, from the tile's corner."""
    own = [np.empty((0, 3))]
    for where, piece in parts.items():
        if where["session"] == session:
            own.append(np.column_stack((piece.sum_x_m, piece.sum_y_m, piece.sum_z_m)) / piece.count[:, None])
    return np.concatenate(own)


def _distances(old: F8, new: F8) -> F8:
    from scipy.spatial import cKDTree

    neighbours = cKDTree(old).query_ball_point(new, RADIUS_M)
    return np.array(list(_flat(old, new, neighbours)))


def _flat(old: F8, new: F8, neighbours: np.ndarray) -> Iterator[float]:
    for point, rows in zip(new, neighbours, strict=True):
        if len(rows) < NEIGHBOURS:
            continue
        around = old[rows]
        middle = around.mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov((around - middle).T))
        distance = float((point - middle) @ axes[:, 0])
        flat = spread[0] < THIN_M**2 and spread[1] > 4 * spread[0]
        if flat and abs(distance) < FAR_M:
            yield distance
