"""Two maps laid over each other: how far their trajectories and their points are apart.

The maps of two runs of one log differ as a whole by a rigid motion, which says nothing of their shape, and otherwise by what
matters. The motion is the mean of what the poses of the same scans say, rotations included: a straight drive has no
rotation about itself that positions alone could tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tiles import Tile
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.neighbourhoods import REACH, Columns
from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_log, transform

F4 = NDArray[np.float32]
I8 = NDArray[np.int64]

FARTHEST_M = 1.0
"""Points without another one so near have none."""
ONLY_M = 0.5
"""A point of one map that has none of the other so near is in one of them only."""
BORDER_M = 2.0
"""Points so near to the border of their tile are not asked for: their neighbours are in another."""


@dataclass(frozen=True)
class PathDifference:
    """The same scans in two maps."""

    scans: int
    as_they_stand_rms_m: float | None
    """Distance in one frame on the Earth, or in that of the first scan; None where the frames do not tell."""
    shift_m: float | None
    """Distance of the motion that lays one map over the other, at the middle of the path."""
    shift_deg: float | None
    aligned_rms_m: float
    """Distance once that is done: the ATE of one by the other."""
    aligned_max_m: float
    aligned_rms_deg: float


def same_scans(a: Poses, b: Poses) -> tuple[F8, F8]:
    """Poses (n, 4, 4) of the scans that both have, by their stamps."""
    _, rows_a, rows_b = np.intersect1d(a.stamp_ns, b.stamp_ns, return_indices=True)
    return a.T_world_lidar[rows_a], b.T_world_lidar[rows_b]


def mean_motion(a: F8, b: F8) -> F8:
    """T_a_b (4, 4), the rigid motion that lays the poses b (n, 4, 4) over a: mean rotation, then mean translation."""
    U, _, Vt = np.linalg.svd((a[:, :3, :3] @ np.swapaxes(b[:, :3, :3], 1, 2)).sum(axis=0))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    T: F8 = pose(R, (a[:, :3, 3] - b[:, :3, 3] @ R.T).mean(axis=0))
    return T


def path_difference(a: F8, b: F8, T_a_b: F8 | None) -> PathDifference:
    """Of the same n > 0 scans in two maps; `T_a_b` is what the frames themselves say, if anything."""
    T = mean_motion(a, b)
    error = inverse(a) @ (T @ b)
    apart, turned = np.linalg.norm(error[:, :3, 3], axis=1), np.linalg.norm(so3_log(error[:, :3, :3]), axis=1)
    standing = shift = turn = None
    if T_a_b is not None:
        middle = b[:, :3, 3].mean(axis=0, keepdims=True)
        shift = float(np.linalg.norm(transform(T, middle) - transform(T_a_b, middle)))
        turn = float(np.degrees(np.linalg.norm(so3_log((inverse(T_a_b) @ T)[:3, :3]))))
        standing = alignment.rms(np.linalg.norm((T_a_b @ b)[:, :3, 3] - a[:, :3, 3], axis=1))
    return PathDifference(
        len(a), standing, shift, turn, alignment.rms(apart), float(apart.max()), alignment.rms(np.degrees(turned))
    )  # fmt: skip


@dataclass(frozen=True)
class Ground:
    """A map as far as it is needed here: where each tile lies, and how to read it."""

    low_m: F8
    """(t, 3) lowest corner of the points of each tile."""
    high_m: F8
    points: I8
    """(t,)"""
    read: Callable[[int], Tile]


def nearest_distances(of: Ground, to: Ground, T_to_of: F8, samples: int) -> F8:
    """Distance of points of one map to the nearest of another, inf beyond `FARTHEST_M`, m.

    The points are sampled evenly, about so many in all; those near the border of their tile are left out. Tiles are read one
    by one, the others as far as they lie around.
    """
    share = samples / max(int(of.points.sum()), 1)
    found = [np.empty(0)]
    for i in range(len(of.points)):
        queries = _inner_points(of.read(i), share)
        if len(queries):
            moved = transform(T_to_of, queries)
            found.append(_to_nearest(moved, _around(to, moved)))
    return np.concatenate(found)


def _inner_points(tile: Tile, share: float) -> F8:
    """Points (m, 3) of the map's frame: every so many of a tile's, those near its border left out."""
    m = int(np.ceil(min(share, 1.0) * len(tile)))
    rows = ((2 * np.arange(m, dtype=np.int64) + 1) * len(tile)) // (2 * max(m, 1))
    local = np.column_stack((tile.x_m[rows], tile.y_m[rows], tile.z_m[rows])).astype(float)
    inner = (local[:, :2] > BORDER_M).all(axis=1) & (local[:, :2] < tile.tile_size_m - BORDER_M).all(axis=1)
    found: F8 = local[inner] + np.array(tile.offset_m)
    return found


def _around(ground: Ground, queries: F8) -> Iterable[F8]:
    """Points of the tiles that come near to any of the queries, tile by tile."""
    low, high = queries.min(axis=0) - FARTHEST_M, queries.max(axis=0) + FARTHEST_M
    for i in np.flatnonzero(((ground.low_m <= high) & (ground.high_m >= low)).all(axis=1)):
        tile = ground.read(int(i))
        points = np.column_stack((tile.x_m, tile.y_m, tile.z_m)).astype(float) + np.array(tile.offset_m)
        yield points[((points >= low) & (points <= high)).all(axis=1)]


def _to_nearest(queries: F8, others: Iterable[F8]) -> F8:
    best = np.full(len(queries), np.inf)
    middle = queries.mean(axis=0)
    asked = (queries - middle).astype(np.float32)
    for points in others:
        if len(points):
            columns = Columns((points - middle).astype(np.float32), FARTHEST_M)
            _nearest(columns.points, columns.starts, columns.shape, columns.low, columns.size_m, asked, best)
    return best


@kernel
def _nearest(points: F4, starts: I8, shape: I8, low: F8, size_m: float, queries: F4, best: F8) -> None:
    """Lower `best` (m,) to the distance of the nearest point, where there is one nearer within `FARTHEST_M`."""
    for i in range(len(queries)):
        least = min(best[i] * best[i], FARTHEST_M * FARTHEST_M)
        hit = False
        cx = int(np.floor((queries[i, 0] - low[0]) / size_m))
        cy = int(np.floor((queries[i, 1] - low[1]) / size_m))
        first_y, last_y = max(cy - REACH, 0), min(cy + REACH + 1, shape[1])
        for gx in range(max(cx - REACH, 0), min(cx + REACH + 1, shape[0])):
            if first_y >= last_y:
                break
            for j in range(starts[gx * shape[1] + first_y], starts[gx * shape[1] + last_y]):
                dx, dy = points[j, 0] - queries[i, 0], points[j, 1] - queries[i, 1]
                dz = points[j, 2] - queries[i, 2]
                squared = float(dx) * dx + float(dy) * dy + float(dz) * dz
                if squared <= least:
                    least, hit = squared, True
        if hit:
            best[i] = np.sqrt(least)
