"""Light from pixels: which values say nothing, and how much brighter one image is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.srgb import LINEAR

U1 = NDArray[np.uint8]
I8 = NDArray[np.int64]
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear red, green, blue (ITU-R BT.709)."""


def sampled(image: U1, pixels: F8) -> tuple[F8, NDArray[np.uint8], NDArray[np.uint8]]:
    """Linear light (n, 3) at pixels (n, 2), and the least and greatest value of the pixels it is from.

    The mean of three by three pixels: noise and the blocks of a compressed image average out.
    """
    rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    return _sampled(np.ascontiguousarray(rgb), np.rint(pixels).astype(np.int64), LINEAR)


@kernel
def _sampled(rgb: U1, pixels: I8, linear: F8) -> tuple[F8, U1, U1]:
    height, width = rgb.shape[:2]
    light = np.zeros((len(pixels), 3))
    low, high = np.full(len(pixels), 255, np.uint8), np.zeros(len(pixels), np.uint8)
    for n in range(len(pixels)):
        u, v = min(max(pixels[n, 0], 1), width - 2), min(max(pixels[n, 1], 1), height - 2)
        for j in range(v - 1, v + 2):
            for i in range(u - 1, u + 2):
                brightest = max(rgb[j, i, 0], rgb[j, i, 1], rgb[j, i, 2])
                low[n], high[n] = min(low[n], brightest), max(high[n], brightest)
                for c in range(3):
                    light[n, c] += linear[rgb[j, i, c]] / 9.0
    return light, low, high
