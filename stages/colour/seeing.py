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

CELLS = 320
"""Cells of the depth image across the picture."""
STEEPEST = 12.0
"""Tangent of the angle between ray and normal beyond which a surface is not followed any further."""
WIDEST_CELLS = 40


def visible(
    model: CameraModel, points: F8, normal: F4, voxel_m: float, margin_px: float, tolerance_m: float
) -> tuple[F8, F4, NDArray[np.int64]]:
    """Pixels (m, 2), cosines (m,) between ray and normal, and rows (m,) of the points that the camera sees.

    points : (n, 3) in the camera's axes, m. normal : (n, 3) in the same axes, zeros where there is none.

    A point is seen when nothing within `margin_px` of it is nearer than its own surface would be there. The
    margin keeps away from edges, where calibration, motion and lens mix two things in one pixel.
    """
    pixels, seen = project(model, points)
    rows = np.flatnonzero(seen)
    away = np.linalg.norm(points[rows], axis=1)
    cell_px = max(model.width_px / CELLS, 1.0)
    focal = 0.5 * (model.fx_px + model.fy_px)
    depth = depth_image(
        pixels[rows], away, focal * voxel_m, cell_px, int(model.width_px / cell_px) + 2,
        int(model.height_px / cell_px) + 2,
    )  # fmt: skip
    reach = int(np.ceil(margin_px / cell_px))
    nearest = _least_around(depth, reach)
    u, v = ((pixels[rows] + 0.5) / cell_px).astype(np.int64).T
    facing = np.abs(np.einsum("ni,ni->n", points[rows], normal[rows].astype(float))) / np.maximum(away, 1e-9)
    cosine = np.where(normal[rows].any(axis=1), facing, 0.5)
    steep = np.minimum(np.sqrt(1.0 - np.minimum(cosine, 1.0) ** 2) / np.maximum(cosine, 1e-3), STEEPEST)
    around_m = voxel_m + (reach + 1) * cell_px / focal * away
    keep = away <= nearest[v, u] + tolerance_m + steep * around_m
    return pixels[rows[keep]], cosine[keep].astype(np.float32), rows[keep]


def depth_image(pixels: F8, away: F8, size_px_m: float, cell_px: float, width: int, height: int) -> F4:
    """Nearest distance (height, width) in each cell; a point at distance d covers `size_px_m` / d pixels to each side."""
    out = np.full((height, width), np.inf, np.float32)
    _splat(np.ascontiguousarray(pixels), np.ascontiguousarray(away), size_px_m, cell_px, out)
    return out


@kernel
def _splat(pixels: F8, away: F8, size_px_m: float, cell_px: float, out: F4) -> None:
    height, width = out.shape
    for n in range(len(away)):
        half = min(size_px_m / away[n] / cell_px, float(WIDEST_CELLS))
        u, v = (pixels[n, 0] + 0.5) / cell_px, (pixels[n, 1] + 0.5) / cell_px
        d = np.float32(away[n])
        for j in range(max(int(v - half), 0), min(int(v + half), height - 1) + 1):
            for i in range(max(int(u - half), 0), min(int(u + half), width - 1) + 1):
                if d < out[j, i]:
                    out[j, i] = d


def _least_around(depth: F4, reach: int) -> F4:
    import cv2

    if reach == 0:
        return depth
    return np.asarray(cv2.erode(depth, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)), np.float32)


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
