"""Images of the room with the board, as a camera takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8, inverse, transform
from scanloom.stages.simulate.boards.print import Print
from scanloom.stages.simulate.boards.room import Look, Scenery
from scanloom.stages.simulate.exposure import Film, develop
from scanloom.stages.simulate.eye import F4, I8, Eye, meet, picture, squares

_PLACES, _CONTRAST = squares(4), 0.08
_AMBIENT = 0.35
_GREY = 0.24
"""Brightness that the exposure brings the image's mean to."""


def radiance_of(
    eye: Eye, T_lidar_camera: F8, scene: Any, scenery: Scenery, lamps: F8, board: Print, T_lidar_board: F8, glare: F8 | None
) -> F4:  # fmt: skip
    """Light (h, w, 3), red green blue, that falls on the sensor; `glare` is where on the board a lamp is mirrored, if
    anywhere."""
    R, place = T_lidar_camera[:3, :3], T_lidar_camera[:3, 3]
    T_board_lidar = inverse(T_lidar_board)

    def look(directions: F8, pixels: I8) -> tuple[F4, I8]:
        d = directions @ R.T
        hit = meet(scene, place, d)
        points = place + d * np.where(hit.found, hit.range_m, 0.0)[:, None]
        light = _light(points, hit.normal, lamps)
        colour = scenery.reflectance(hit.triangle, points, T_board_lidar, board) * light[:, None]
        kind = scenery.look[hit.triangle]
        colour[kind == Look.SHINING] = 12.0
        if glare is not None:
            printed = kind == Look.PRINTED
            at = transform(T_board_lidar, points[printed])[:, :2]
            gap2 = (((at - glare[:2]) / glare[2]) ** 2).sum(axis=1)
            colour[printed] += (9.0 * np.exp(-gap2) + 0.35 * np.exp(-gap2 / 9))[:, None]
        colour[~hit.found | ~directions.any(axis=1)] = 0.0
        return colour.astype(np.float32), hit.triangle

    return picture(eye, look, _PLACES, _CONTRAST)


def taken(radiance: F4, eye: Eye, blur_px: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """An image (h, w, 3) of light, with an exposure that is a little off and noise."""
    brightness = np.minimum(radiance.mean(axis=2), 1.0)
    exposure = _GREY / max(float(brightness.mean()), 1e-3) * float(np.exp(0.15 * rng.standard_normal()))
    return develop(radiance, exposure, eye.model, Film(blur_px=blur_px), rng)


def _light(points: F8, normals: F8, lamps: F8) -> F8:
    """What falls on surfaces: from everywhere a little, from lamps by distance and angle (Lambert)."""
    light = np.full(len(points), _AMBIENT)
    for lamp in lamps:
        to_lamp = lamp - points
        d2 = np.maximum(np.einsum("ni,ni->n", to_lamp, to_lamp), 0.25)
        cosine = np.einsum("ni,ni->n", to_lamp, normals) / np.sqrt(d2)
        light += 1.6 * np.maximum(cosine, 0.0) / d2
    return light
