"""A rolling shutter: the rows of an image are taken one after another, while the camera moves on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8, so3_exp, so3_log

_ROUNDS = 3
"""Each makes a row's error smaller by how much of the picture's height the scene moves in the meantime: 5 % in a hard case."""


@dataclass(frozen=True)
class Sweep:
    """How a camera moves while it reads one image, from the first row to the last."""

    turn: F8
    """(3,) rotation vector in the camera's axes, rad."""
    shift: F8
    """(3,) in the camera's axes when the middle row is taken, m."""

    @classmethod
    def between(cls, T_first: F8, T_middle: F8, T_last: F8) -> Sweep:
        """From poses (4, 4) of the camera when its first, middle and last row are taken."""
        turn = so3_log((T_first[:3, :3].T @ T_last[:3, :3])[None])[0]
        return cls(turn, T_middle[:3, :3].T @ (T_last[:3, 3] - T_first[:3, 3]))

    @property
    def turned_rad(self) -> float:
        return float(np.linalg.norm(self.turn))


def as_met(model: CameraModel, sweep: Sweep, points: F8) -> F8:
    """Points (n, 3) in the camera's axes at the time of the row that shows each, from those at the time of the middle row.

    Which row that is depends on where the camera is by then: found by repetition. What no row shows is brought to the nearest
    row's time, or stays.
    """
    share = np.zeros(len(points))
    for _ in range(_ROUNDS):
        row = project(model, _after(sweep, share, points))[0][:, 1]
        share = np.clip(np.nan_to_num(row / max(model.height_px - 1, 1) - 0.5, nan=0.0), -0.5, 0.5)
    return _after(sweep, share, points)


def _after(sweep: Sweep, share: F8, points: F8) -> F8:
    """Points in the axes of the camera after a share (n,) of its sweep, from the middle."""
    R = so3_exp(share[:, None] * sweep.turn)
    return np.asarray(np.einsum("nji,nj->ni", R, points - share[:, None] * sweep.shift))
