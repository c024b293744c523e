"""Intrinsics as numbers that a graph may move: focal lengths, centre, and the coefficients of the lens."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.geometry.camera import project, rays
from scanloom.stages.geometry.se3 import F8

_FIELDS = ("fx_px", "fy_px", "cx_px", "cy_px")
_PIXEL_STEP, _BEND_STEP = 1e-2, 1e-5
_FIXED_PX = 1e-6
"""Standard deviation of what is believed."""


def corrected(model: CameraModel, shift: F8) -> CameraModel:
    """A model with fx, fy, cx, cy, px, and then its coefficients moved by `shift` (4 + coefficients,)."""
    moved = {field: getattr(model, field) + float(d) for field, d in zip(_FIELDS, shift)}
    bend = tuple(k + float(d) for k, d in zip(model.distortion, shift[4:], strict=True))
    return model.model_copy(update={**moved, "distortion": bend})


def by_intrinsics(model: CameraModel, directions: F8) -> F8:
    """How pixels (n,) of directions (n, 3) of the camera move with its intrinsics: (n, 2, 4 + coefficients)."""
    count = 4 + len(model.distortion)
    steps = np.diag(np.r_[np.full(4, _PIXEL_STEP), np.full(count - 4, _BEND_STEP)])
    columns = [
        (project(corrected(model, step), directions)[0] - project(corrected(model, -step), directions)[0])
        / (2 * step.sum())
        for step in steps
    ]
    return np.stack(columns, axis=-1)


def prior_sigmas(model: CameraModel, share: float, bend_px: float) -> F8:
    """Standard deviations (4 + coefficients,): `share` of the focal length; coefficients so that each alone moves a corner
    of the image by `bend_px`. What is 0 is believed."""
    pixels = max(share * model.fx_px, _FIXED_PX)
    corners = np.array(
        [(0, 0), (model.width_px - 1, 0), (0, model.height_px - 1), (model.width_px - 1, model.height_px - 1)]
    )
    moves = by_intrinsics(model, rays(model, corners.astype(np.float64)))[:, :, 4:]
    reach = np.nan_to_num(np.linalg.norm(moves, axis=1)).max(axis=0, initial=_FIXED_PX)
    return np.asarray(np.r_[np.full(4, pixels), max(bend_px, _FIXED_PX) / reach], np.float64)
