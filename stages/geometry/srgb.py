"""The curve of sRGB (IEC 61966-2-1): linear light from values of a picture, and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LEVELS = np.arange(256) / 255.0
LINEAR = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4)
"""Light of each of the 256 values; 1 is white."""


def srgb(light: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Values of linear light."""
    level = np.clip(light, 0.0, 1.0)
    curve = np.where(level <= 0.0031308, 12.92 * level, 1.055 * np.power(level, 1 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * curve), np.uint8)
