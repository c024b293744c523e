"""Which points of the map a camera sees: a coarse depth image of all of them, each as large as its voxel appears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.colour.settings import Settings
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I8 = NDArray[np.int64]

CELLS = 640
"""Cells of the depth image across the picture."""
WIDEST_CELLS = 80
BARE_COSINE = 0.5
"""Of a point without a surface."""
SLOPE, OF_COSINE = 0.1, 0.5
"""Surfaces are flat to `SLOPE`, and normals true: what is farther aside may stand out by so much more. On a surface that is looked along
this must stay well below the cosine between ray and normal: what is straight before a point at a distance d stands out of its surface
by d times the cosine, and would never hide it."""


@dataclass(frozen=True)
class Seen:
    """Points that a camera sees."""

    pixels: F8
    """(m, 2)."""
    cosine: F4
    """(m,) between ray and normal; one half where there is none."""
    rows: I8
    """(m,) of the points that were asked for."""
    surely: B1
    """(m,) whether by so much that no second image need agree, see `alone` of the settings."""


def visible(settings: Settings, model: CameraModel, points: F8, normal: F4, voxel_m: float) -> Seen:
    """What a camera sees of points (n, 3) in its axes, m, that each stand for a voxel.

    normal : (n, 3) in the same axes, towards the side that the LiDAR saw; zeros where there is none.

    A point is seen when its surface faces the camera, by `least_cosine` or more, and nothing within `margin_px` of it is nearer and stands
    out of that surface. The margin keeps away from edges, where calibration, motion and lens mix two things in one pixel; beyond the
    picture's own edge anything may stand. Points without a surface are too far from each other to hide one another from afar.
    """
    s = settings
    pixels, inside = project(model, points)
    rows = np.flatnonzero(inside)
    pixels, points = np.ascontiguousarray(pixels[rows]), np.ascontiguousarray(points[rows])
    towards = normal[rows].astype(np.float64)
    away = np.sqrt(np.einsum("ni,ni->n", points, points))
    cosine = -np.einsum("ni,ni->n", points, towards) / np.maximum(away, 1e-9)
    flat = towards.any(axis=1)
    cell_px = max(model.width_px / CELLS, 1.0)
    size_px_m = 0.5 * (model.fx_px + model.fy_px) * voxel_m
    first = nearest(pixels, away, size_px_m, cell_px, (model.height_px, model.width_px))
    reach = int(np.ceil(s.margin_px / cell_px))
    faces = np.where(flat, cosine >= s.least_cosine, away <= s.bare_m)
    asked = np.flatnonzero(faces & _within(model, pixels, s.margin_px))
    before_m = _before(asked, pixels, points, away, towards, cosine, first, cell_px, reach, s.tolerance_m)
    free = before_m <= s.tolerance_m
    keep, before_m = asked[free], before_m[free]
    cosine = np.where(flat, cosine, BARE_COSINE)[keep]
    surely = (cosine >= s.alone * s.least_cosine) & (before_m <= s.tolerance_m / s.alone)
    return Seen(pixels[keep], cosine.astype(np.float32), rows[keep], surely)


def _within(model: CameraModel, pixels: F8, margin_px: float) -> B1:
    """Which pixels (n, 2) are farther than a margin from the picture's edge."""
    off = np.abs(pixels - (0.5 * (model.width_px - 1), 0.5 * (model.height_px - 1)))
    inset = 0.5 * np.array([model.width_px, model.height_px]) - margin_px
    return np.asarray((off < inset).all(axis=1))


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
def _before(
    asked: I8, pixels: F8, points: F8, away: F8, towards: F8, cosine: F8, first: I8, cell_px: float, reach: int, most_m: float
) -> F8:  # fmt: skip
    """By how much (m,) something in the cells around each of the points `asked` for stands before it, m; what is more than `most_m`
    need not be the most there is."""
    height, width = first.shape
    found = np.zeros(len(asked))
    for row in range(len(asked)):
        n = asked[row]
        u, v = int((pixels[n, 0] + 0.5) / cell_px), int((pixels[n, 1] + 0.5) / cell_px)
        for j in range(max(v - reach, 0), min(v + reach, height - 1) + 1):
            for i in range(max(u - reach, 0), min(u + reach, width - 1) + 1):
                k = first[j, i]
                if k >= 0 and away[n] - away[k] > found[row]:
                    found[row] = max(found[row], _stands_before(k, n, points, away, towards, cosine))
            if found[row] > most_m:
                break
    return found


@kernel
def _stands_before(k: int, n: int, points: F8, away: F8, towards: F8, cosine: F8) -> float:
    """By how much point k, in about the direction of point n, is before it, m.

    As much as it is nearer, and stands out of the plane through n. For a point without a normal being nearer counts half.
    """
    nearer = away[n] - away[k]
    if towards[n, 0] == 0.0 and towards[n, 1] == 0.0 and towards[n, 2] == 0.0:
        return float(0.5 * nearer)
    x, y, z = points[k, 0] - points[n, 0], points[k, 1] - points[n, 1], points[k, 2] - points[n, 2]
    out = x * towards[n, 0] + y * towards[n, 1] + z * towards[n, 2]
    out -= min(SLOPE, OF_COSINE * cosine[n]) * np.sqrt(x * x + y * y + z * z)
    return float(min(nearer, out))


def through_boxes(origin: F8, points: F8, boxes: F8, half: F8) -> B1:
    """Which of the lines from `origin` (3,) to points (n, 3) touch a box.

    boxes : (m, 4, 4) poses of the middles of the boxes in the frame of the points; half : (m, 3) half their sizes.
    The slab test of Kay and Kajiya (1986).
    """
    return _through_boxes(origin, np.ascontiguousarray(points), boxes, half)


@kernel
def _through_boxes(origin: F8, points: F8, boxes: F8, half: F8) -> B1:
    hit = np.zeros(len(points), np.bool_)
    for b in range(len(boxes)):
        for n in range(len(points)):
            enter, leave = 0.0, 1.0
            for axis in range(3):
                start, way = 0.0, 0.0
                for k in range(3):
                    start += (origin[k] - boxes[b, k, 3]) * boxes[b, k, axis]
                    way += (points[n, k] - origin[k]) * boxes[b, k, axis]
                if abs(way) < 1e-12:
                    way = 1e-12
                one, other = (-half[b, axis] - start) / way, (half[b, axis] - start) / way
                enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
            hit[n] |= enter <= leave
    return hit
