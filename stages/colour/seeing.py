"""Which points of the map a camera sees: a coarse depth image of all of them, each as large as its voxel appears."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I8 = NDArray[np.int64]

CELLS = 640
"""Cells of the depth image across the picture."""
WIDEST_CELLS = 80
SLOPE, OF_COSINE = 0.1, 0.5
"""Surfaces are flat to `SLOPE`, and normals true: what is farther aside may stand out by so much more. On a surface that is looked along
this must stay well below the cosine between ray and normal: what is straight before a point at a distance d stands out of its surface
by d times the cosine, and would never hide it."""


def visible(
    model: CameraModel,
    points: F8,
    normal: F4,
    voxel_m: float,
    margin_px: float,
    tolerance_m: float,
    least_cosine: float,
) -> tuple[F8, F4, I8]:
    """Pixels (m, 2), cosines (m,) between ray and normal, and rows (m,) of the points that the camera sees.

    points : (n, 3) in the camera's axes, m. normal : (n, 3) in the same axes, towards the side that the LiDAR saw; zeros where there
    is none.

    A point is seen when its surface faces the camera, by `least_cosine` or more, and nothing within `margin_px` of it is nearer and stands
    out of that surface. The margin keeps away from edges, where calibration, motion and lens mix two things in one pixel.
    """
    pixels, seen = project(model, points)
    rows = np.flatnonzero(seen)
    pixels, points = np.ascontiguousarray(pixels[rows]), np.ascontiguousarray(points[rows])
    towards = normal[rows].astype(np.float64)
    away = np.linalg.norm(points, axis=1)
    cosine = -np.einsum("ni,ni->n", points, towards) / np.maximum(away, 1e-9)
    faces = (cosine >= least_cosine) | ~towards.any(axis=1)
    cell_px = max(model.width_px / CELLS, 1.0)
    size_px_m = 0.5 * (model.fx_px + model.fy_px) * voxel_m
    first = nearest(pixels, away, size_px_m, cell_px, (model.height_px, model.width_px))
    reach = int(np.ceil(margin_px / cell_px))
    asked = np.flatnonzero(faces)
    keep = asked[_free(asked, pixels, points, away, towards, cosine, first, cell_px, reach, tolerance_m)]
    cosine = np.where(towards.any(axis=1), cosine, 0.5)
    return pixels[keep], cosine[keep].astype(np.float32), rows[keep]


def nearest(pixels: F8, away: F8, size_px_m: float, cell_px: float, shape: tuple[int, int]) -> I8:
    """Number of the nearest point in each cell of a picture of `shape`, -1 where there is none; a point at distance d
    covers `size_px_m` / d pixels to each side."""
    height, width = (int(side / cell_px) + 2 for side in shape)
    first, depth = np.full((height, width), -1, np.int64), np.full((height, width), np.inf)
    _splat(pixels, away, size_px_m, cell_px, first, depth)
    return first


@kernel
def _splat(pixels: F8, away: F8, size_px_m: float, cell_px: float, first: I8, depth: F8) -> None:
    height, width = first.shape
    for n in range(len(away)):
        half = min(size_px_m / away[n] / cell_px, float(WIDEST_CELLS))
        u, v = (pixels[n, 0] + 0.5) / cell_px, (pixels[n, 1] + 0.5) / cell_px
        for j in range(max(int(v - half), 0), min(int(v + half), height - 1) + 1):
            for i in range(max(int(u - half), 0), min(int(u + half), width - 1) + 1):
                if away[n] < depth[j, i]:
                    depth[j, i], first[j, i] = away[n], n


@kernel
def _free(
    asked: I8, pixels: F8, points: F8, away: F8, towards: F8, cosine: F8, first: I8, cell_px: float, reach: int, tolerance_m: float
) -> B1:  # fmt: skip
    """Which of the points `asked` for have nothing before them in the cells around theirs."""
    height, width = first.shape
    free = np.ones(len(asked), np.bool_)
    for row in range(len(asked)):
        n = asked[row]
        u, v = int((pixels[n, 0] + 0.5) / cell_px), int((pixels[n, 1] + 0.5) / cell_px)
        for j in range(max(v - reach, 0), min(v + reach, height - 1) + 1):
            for i in range(max(u - reach, 0), min(u + reach, width - 1) + 1):
                k = first[j, i]
                if free[row] and k >= 0 and k != n:
                    free[row] = not _hides(k, n, points, away, towards, cosine, tolerance_m)
    return free


@kernel
def _hides(k: int, n: int, points: F8, away: F8, towards: F8, cosine: F8, tolerance_m: float) -> bool:
    """Whether point k, in about the direction of point n, is before it.

    What is nearer by more than the tolerance hides a point if it stands out of the plane through it. A point without a
    normal is hidden by whatever is nearer by twice as much.
    """
    if towards[n, 0] == 0.0 and towards[n, 1] == 0.0 and towards[n, 2] == 0.0:
        return bool(away[k] < away[n] - 2.0 * tolerance_m)
    if away[k] >= away[n] - tolerance_m:
        return False
    x, y, z = points[k, 0] - points[n, 0], points[k, 1] - points[n, 1], points[k, 2] - points[n, 2]
    out = x * towards[n, 0] + y * towards[n, 1] + z * towards[n, 2]
    return bool(out > tolerance_m + min(SLOPE, OF_COSINE * cosine[n]) * np.sqrt(x * x + y * y + z * z))


def through_boxes(origin: F8, points: F8, boxes: F8, half: F8) -> B1:
    """Which of the lines from `origin` (3,) to points (n, 3) touch a box.

    boxes : (m, 4, 4) poses of the middles of the boxes in the frame of the points; half : (m, 3) half their sizes.
    The slab test of Kay and Kajiya (1986).
    """
    hit = np.zeros(len(points), bool)
    for T, size in zip(boxes, half):
        start = (origin - T[:3, 3]) @ T[:3, :3]
        way = (points - T[:3, 3]) @ T[:3, :3] - start
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        near, far = (-size - start) / way, (size - start) / way
        enter = np.minimum(near, far).max(axis=1)
        leave = np.maximum(near, far).min(axis=1)
        hit |= (enter <= leave) & (leave >= 0.0) & (enter <= 1.0)
    return hit
