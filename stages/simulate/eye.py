"""A camera's eye: the ray of every pixel, and pictures of what rays meet, smooth where edges run through pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.geometry.camera import rays
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
I8 = NDArray[np.int64]
B1 = NDArray[np.bool_]

Look = Callable[[F8, I8], tuple[F4, I8]]
"""Radiance (n, 3) and a number of what is seen (n,) along directions (n, 3) of the camera, for pixels (n,)."""


class Met(NamedTuple):
    """What rays (n,) meet first."""

    range_m: F8
    """Infinite where nothing is met."""
    triangle: I8
    """0 where nothing is met."""
    normal: F8
    """(n, 3) unit, towards where the ray comes from."""
    found: B1


def meet(scene: Any, origins: F8, directions: F8) -> Met:
    """First surfaces along rays (n, 3), (n, 3) of a scene of triangles."""
    import open3d as o3d

    tensor: Any = o3d.core.Tensor  # its stubs know nothing of numpy
    lines = np.concatenate((np.broadcast_to(origins, directions.shape), directions), axis=1)
    hit = scene.cast_rays(tensor(np.ascontiguousarray(lines, dtype=np.float32)))
    range_m = hit["t_hit"].numpy().astype(np.float64)
    found = np.isfinite(range_m)
    triangle = np.where(found, hit["primitive_ids"].numpy(), 0).astype(np.int64)
    normal = hit["primitive_normals"].numpy().astype(np.float64)
    away = np.einsum("ni,ni->n", normal, directions) > 0
    normal[away] *= -1.0
    return Met(range_m, triangle, normal, found)


class Eye:
    """Rays of all pixels of a camera, and of places between them."""

    def __init__(self, model: CameraModel) -> None:
        self.model = model
        self.height, self.width = model.height_px, model.width_px
        # What the lens cannot see stays dark: a direction of no length.
        self._grid = np.nan_to_num(_grid(model))

    @property
    def pixels(self) -> I8:
        """Numbers of all pixels, row by row."""
        return np.arange(self.height * self.width)

    def directions(self, pixels: I8, right: float = 0.0, down: float = 0.0) -> F8:
        """Unit directions (n, 3) of places `right` and `down` of the pixels' centres, within a pixel.

        Between four centres by their mean: off by the lens's curvature over a pixel, 1e-4 px for a strong lens.
        """
        row, column = np.divmod(pixels, self.width)
        i, j = int(np.floor(down)), int(np.floor(right))
        y, x = down - i, right - j
        row, column = row + 1 + i, column + 1 + j
        d: F8 = (1 - y) * (1 - x) * self._grid[row, column]
        for weight, di, dj in (((1 - y) * x, 0, 1), (y * (1 - x), 1, 0), (y * x, 1, 1)):
            if weight:
                d += weight * self._grid[row + di, column + dj]
        length = np.linalg.norm(d, axis=1, keepdims=True)
        return np.asarray(d / np.where(length > 0.5, length, np.inf))


def _grid(model: CameraModel) -> F8:
    """Rays (h + 2, w + 2, 3) of all pixels and one more on each side; by a spline through some where all are known."""
    from scipy.interpolate import RectBivariateSpline

    v, u = np.arange(-1.0, model.height_px + 1), np.arange(-1.0, model.width_px + 1)
    rows, columns = (np.linspace(x[0], x[-1], len(x) // _KNOT_PX + 5) for x in (v, u))
    U, V = np.meshgrid(columns, rows)
    knots = rays(model, np.column_stack((U.ravel(), V.ravel()))).reshape(*U.shape, 3)
    if np.isfinite(knots).all():
        return np.stack([RectBivariateSpline(rows, columns, knots[..., k])(v, u) for k in range(3)], axis=-1)
    U, V = np.meshgrid(u, v)
    return rays(model, np.column_stack((U.ravel(), V.ravel()))).reshape(len(v), len(u), 3)


_KNOT_PX = 8
"""Between knots of the spline: it is within 1e-5 px there."""


def squares(samples: int) -> tuple[tuple[float, float], ...]:
    """Places right of and below a pixel's centre: a grid of `samples` squared."""
    places = ((np.arange(samples) + 0.5) / samples - 0.5).tolist()
    return tuple((right, down) for down in places for right in places)


def picture(eye: Eye, look: Look, places: Sequence[tuple[float, float]], contrast: float) -> F4:
    """Radiance (h, w, 3): one ray a pixel; the mean over `places` where neighbours show other things, or differ in
    brightness by more than `contrast` of their own. A place at the centre costs nothing."""
    shape = eye.height, eye.width
    radiance, what = look(eye.directions(eye.pixels), eye.pixels)
    rows = np.flatnonzero(_uneven(radiance.sum(axis=1).reshape(shape), what.reshape(shape), contrast))
    if len(rows):
        total = np.zeros((len(rows), 3), np.float32)
        for right, down in places:
            centre = right == 0.0 and down == 0.0
            total += radiance[rows] if centre else look(eye.directions(rows, right, down), rows)[0]
        radiance[rows] = total / np.float32(len(places))
    return radiance.reshape(*shape, 3)


def _uneven(brightness: F4, what: I8, contrast: float) -> B1:
    """Pixels with a neighbour that differs, (h, w) as one row."""
    uneven = np.zeros(brightness.shape, bool)
    for axis in (0, 1):
        ahead = np.moveaxis(uneven, axis, 0)[1:]
        behind = np.moveaxis(uneven, axis, 0)[:-1]
        b, w = np.moveaxis(brightness, axis, 0), np.moveaxis(what, axis, 0)
        step = (w[1:] != w[:-1]) | (np.abs(b[1:] - b[:-1]) > contrast * np.minimum(b[1:], b[:-1]) + 1e-4)
        ahead |= step
        behind |= step
    wide = uneven.copy()
    wide[1:] |= uneven[:-1]
    wide[:-1] |= uneven[1:]
    wide[:, 1:] |= uneven[:, :-1]
    wide[:, :-1] |= uneven[:, 1:]
    return wide.ravel()
