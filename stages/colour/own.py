"""The own vehicle in the pictures: parts of a picture that say of many places what other pictures of these places do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.colour.looking import CELLS_ACROSS, CELLS_DOWN
from scanloom.stages.colour.views import F4, Views

B1 = NDArray[np.bool_]

DISAGREES = 0.35
"""Logarithm of light that a view is off the others of its point."""
LEAST_VIEWS, LEAST_IMAGES = 40, 4
"""Of a cell, before anything is said of it."""
LEAST_OTHERS = 3
"""Views of a point, before one of them is said to be off."""


def on_own_vehicle(views: Views, off: F4, cameras: int, share: float) -> B1:
    """Which views (n,) lie in cells where more than a `share` of them disagree with other views of the same points.

    off : (n,) how far a view is from the consensus of its point. Cells beside such a cell are left out, too.
    """
    cells = cameras * CELLS_DOWN * CELLS_ACROSS
    starts = views.starts
    several = np.repeat(np.diff(starts) >= LEAST_OTHERS, np.diff(starts))
    asked = np.bincount(views.cell[several], minlength=cells)
    wrong = np.bincount(views.cell[several & (off > DISAGREES)], minlength=cells)
    pairs = np.unique(views.cell[several].astype(np.int64) << 32 | views.image[several])
    images = np.bincount((pairs >> 32).astype(np.int64), minlength=cells)
    own = (asked >= LEAST_VIEWS) & (images >= LEAST_IMAGES) & (wrong > share * asked)
    grid = _grown(own.reshape(cameras, CELLS_DOWN, CELLS_ACROSS))
    return np.asarray(grid.ravel()[views.cell])


def _grown(own: B1) -> B1:
    grown = own.copy()
    grown[:, 1:] |= own[:, :-1]
    grown[:, :-1] |= own[:, 1:]
    grown[:, :, 1:] |= own[:, :, :-1]
    grown[:, :, :-1] |= own[:, :, 1:]
    return grown
