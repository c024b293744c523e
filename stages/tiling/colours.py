"""Colours of a tile's points from what the images of all sessions saw of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tiles import Colours
from scanloom.stages.geometry.srgb import srgb


def coloured(voxel: NDArray[np.int64], found: Iterable[Colours]) -> dict[str, Any]:
    """Columns `colour` and `views` of the voxels (n,), ascending; zeros for those that no image saw.

    Sums are whole numbers: the result does not depend on the order of the sessions.
    """
    weight, views = np.zeros(len(voxel), np.int64), np.zeros(len(voxel), np.int64)
    light = np.zeros((len(voxel), 3), np.int64)
    for paint in found:
        at = np.searchsorted(voxel, paint.voxel)
        known = at < len(voxel)
        known[known] = voxel[at[known]] == paint.voxel[known]
        rows = at[known]
        weight[rows] += paint.weight[known]
        light[rows] += paint.light[known]
        views[rows] += paint.views[known]
    mean = light / Colours.LIGHT_STEPS / np.maximum(weight / Colours.WEIGHT_STEPS, 1e-9)[:, None]
    colour = np.where(views[:, None] > 0, np.maximum(srgb(mean), 1), 0).astype(np.uint8)
    return {"colour": colour, "views": np.minimum(views, 65535).astype(np.uint16)}
