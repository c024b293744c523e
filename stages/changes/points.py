"""The points of the old map that are asked: what stands about, one per voxel, tile by tile."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT, RANK_SHIFT, Piece
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import downsample

FOOT_M = 1.0
"""Edge of the columns in which the lowest point is looked for."""


def standing_points(tile: str, pieces: Sequence[Piece], thinning_m: float, clearance_m: float) -> F8:
    """Points (n, 3) of the map's frame that the pieces of a tile hold and that are no ground, thinned.

    Those less than `clearance_m` above the lowest point of their column are left out as well: far from the road not all
    ground is known as such, and rays that graze it see through it.
    """
    pieces = [piece.take(_stood(piece)) for piece in pieces]
    voxel = np.concatenate([piece.voxel & ((1 << RANK_SHIFT) - 1) for piece in pieces])
    order = np.argsort(voxel, kind="stable")
    starts = np.flatnonzero(np.diff(voxel[order], prepend=-1))

    def total(name: str) -> F8:
        values = np.concatenate([getattr(piece, name) for piece in pieces]).astype(np.float64)
        return np.asarray(np.add.reduceat(values[order], starts))

    if not len(voxel):
        return np.empty((0, 3))
    count = total("count")
    standing = 2.0 * total("ground_count") <= count
    size = pieces[0].tile_size_m
    corner = np.array([*corner_of(tile, size), 0.0])
    sums = np.column_stack([total(f"sum_{axis}_m") for axis in "xyz"])
    places = sums / count[:, None]
    points = (places + corner)[standing & (_above_lowest(places) >= clearance_m)]
    return np.ascontiguousarray(points[downsample(points - corner, thinning_m)])


def _stood(piece: Piece) -> NDArray[np.bool_]:
    """Rows of the map and of what was taken out of it because it has changed."""
    rank = piece.voxel >> RANK_SHIFT
    return np.asarray((rank == 0) | (rank == 1 + LEFT_OUT.index(PointClass.CHANGED)))


def _above_lowest(places: F8) -> F8:
    """Height (n,) of each place (n, 3) above the lowest one in its column of a metre, m."""
    column = np.floor(places[:, :2] / FOOT_M).astype(np.int64)
    _, number = np.unique(column[:, 0] * (1 << 20) + column[:, 1], return_inverse=True)
    lowest = np.full(number.max() + 1, np.inf)
    np.minimum.at(lowest, number, places[:, 2])
    return np.asarray(places[:, 2] - lowest[number])


def corner_of(tile: str, size_m: float) -> tuple[float, float]:
    """Lower corner of a tile named `X_Y`, m."""
    x, y = tile.split("_")
    return int(x) * size_m, int(y) * size_m
