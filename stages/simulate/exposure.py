"""From light to an image: lens fall-off, blur, bloom, noise of the sensor, saturation, and the curve of its tones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel

F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]

_STANDARD = 0.0031308
"""Below it the curve of sRGB (IEC 61966-2-1) is straight."""


@dataclass(frozen=True)
class Film:
    """What the sensor does to light; 1 is where it saturates."""

    blur_px: float = 0.6
    """Standard deviation of a point."""
    falloff: float = 0.35
    """Light lost in the corners."""
    bloom: float = 0.03
    """Share of the light beyond saturation that spreads around."""
    electrons: float = 9000.0
    """A saturated pixel has so many: its shot noise is their root."""
    read_electrons: float = 12.0


def develop(radiance: F4, exposure: float, model: CameraModel, film: Film, rng: np.random.Generator) -> U1:
    """Image (h, w, 3) red green blue from radiance (h, w, 3) times `exposure`."""
    import cv2

    light = radiance * np.float32(exposure) * falloff(model, film.falloff)[..., None]
    if film.blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), film.blur_px)
    beyond = np.maximum(light - 1.0, 0.0)
    if film.bloom > 0 and beyond.any():
        light = light + np.float32(film.bloom) * _spread(np.minimum(beyond, 50.0))
    count = np.minimum(light, 1.2) * np.float32(film.electrons)
    noise = rng.standard_normal(count.shape, np.float32)
    count = count + noise * np.sqrt(np.maximum(count, 0.0) + np.float32(film.read_electrons**2))
    return toned(count / np.float32(film.electrons))


def _spread(light: F4) -> F4:
    """Light around what is too bright, in a small image: a fiftieth of the width, standard deviation."""
    import cv2

    h, w = light.shape[:2]
    small = cv2.resize(light, (max(w // 8, 1), max(h // 8, 1)), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(cv2.GaussianBlur(small, (0, 0), w / 400), (w, h)), np.float32)


def toned(light: F4) -> U1:
    """sRGB values of linear light."""
    steps = 4096
    level = np.arange(steps + 1) / steps
    curve = np.where(level <= _STANDARD, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    table = np.round(255 * curve).astype(np.uint8)
    return np.asarray(table[(np.clip(light, 0.0, 1.0) * steps + 0.5).astype(np.int64)])


def falloff(model: CameraModel, share: float) -> F4:
    """Light that reaches each pixel (h, w): all in the middle, `share` less in the corners."""
    u = (np.arange(model.width_px) - (model.width_px - 1) / 2) / (model.width_px / 2)
    v = (np.arange(model.height_px) - (model.height_px - 1) / 2) / (model.height_px / 2)
    return np.asarray(1.0 - share * (u[None, :] ** 2 + v[:, None] ** 2) ** 1.5 / 2**1.5, np.float32)
