"""Light from pixels: which values say nothing, and how much brighter one image is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.srgb import LINEAR

U1 = NDArray[np.uint8]
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear red, green, blue (ITU-R BT.709)."""


def sampled(image: U1, pixels: F8) -> tuple[F8, NDArray[np.uint8], NDArray[np.uint8]]:
    """Linear light (n, 3) at pixels (n, 2), and the least and greatest value of the pixels it is from.

    The mean of three by three pixels: noise and the blocks of a compressed image average out.
    """
    height, width = image.shape[:2]
    rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    u = np.clip(np.rint(pixels[:, 0]).astype(np.int64), 1, width - 2)
    v = np.clip(np.rint(pixels[:, 1]).astype(np.int64), 1, height - 2)
    light = np.zeros((len(pixels), 3))
    low, high = np.full(len(pixels), 255, np.uint8), np.zeros(len(pixels), np.uint8)
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            value = rgb[v + j, u + i]
            light += LINEAR[value] / 9.0
            low, high = np.minimum(low, value.max(axis=1)), np.maximum(high, value.max(axis=1))
    return light, low, high
