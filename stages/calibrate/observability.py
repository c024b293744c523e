"""Which direction of a camera's pose is known worst, in words, and which further placement would help most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.boards import Pair
from scanloom.stages.geometry.camera import project, rays
from scanloom.stages.geometry.se3 import F8, adjoint, inverse, pose, so3_exp, transform

_REACH_M = 5.0
"""A turn counts as much as the shift it makes at this distance."""
_TURNS = (
    "pitch (about the camera's right axis)",
    "yaw (about its down axis)",
    "roll (about its viewing axis)",
)
_SHIFTS = ("right or left", "down or up", "forward or back")
_TILTS_DEG = (0.0, 40.0)


@dataclass(frozen=True)
class Weakness:
    """In words."""

    direction: str
    advice: str


def weakness(covariance: F8, camera: CameraModel, board: Board, found: Sequence[Pair]) -> Weakness:
    """The weakest direction of a covariance (6, 6), and the best of many imagined placements.

    A placement is judged by what it leaves of the weakest direction, with a board as certain as those there are.
    """
    return Weakness(_direction(covariance), _advice(covariance, camera, board, found))


def _scaled(covariance: F8) -> F8:
    """Turns as shifts at `_REACH_M`."""
    scale = np.r_[np.full(3, _REACH_M), np.ones(3)]
    return np.asarray(covariance * np.outer(scale, scale))


def _direction(covariance: F8) -> str:
    """The axis with most of the largest eigenvector; turn and shift where both take part."""
    values, vectors = np.linalg.eigh(_scaled(covariance))
    v, sigma = vectors[:, -1], np.sqrt(values[-1])
    turn, shift = np.linalg.norm(v[:3]), np.linalg.norm(v[3:])
    words = []
    if turn > 0.3:
        axis = int(np.argmax(np.abs(v[:3])))
        words.append(f"{_TURNS[axis]} by {np.degrees(sigma * turn / _REACH_M):.3f} degrees")
    if shift > 0.3:
        axis = int(np.argmax(np.abs(v[3:])))
        words.append(f"a shift {_SHIFTS[axis]} by {sigma * shift * 1e3:.1f} mm")
    return " together with ".join(words)


def _advice(covariance: F8, camera: CameraModel, board: Board, found: Sequence[Pair]) -> str:
    usual = np.mean([pair.covariance for pair in found], axis=0)
    known = np.linalg.inv(covariance)
    near = float(np.median([np.linalg.norm(pair.T_camera_board[:3, 3]) for pair in found]))
    best, words = np.inf, ""
    for T, name in _imagined(camera, board, near):
        J = adjoint(inverse(T))
        after = np.linalg.inv(known + J.T @ np.linalg.solve(usual, J))
        left = float(np.linalg.eigvalsh(_scaled(after))[-1])
        if left < best:
            best, words = left, name
    if not words:
        return ""
    before = float(np.linalg.eigvalsh(_scaled(covariance))[-1])
    return f"{words}: takes {100 * (1 - np.sqrt(best / before)):.0f} % off the weakest direction"


def _imagined(camera: CameraModel, board: Board, near: float) -> list[tuple[F8, str]]:
    """Boards at nine places of the image and two distances, flat on or tilted four ways, if wholly in the image."""
    found = []
    grid = [("upper", 0.2), ("middle", 0.5), ("lower", 0.8)], [("left", 0.2), ("middle", 0.5), ("right", 0.8)]
    for row, v in grid[0]:
        for column, u in grid[1]:
            pixel = np.array([[u * (camera.width_px - 1), v * (camera.height_px - 1)]])
            direction = rays(camera, pixel)[0]
            if not np.isfinite(direction).all():
                continue
            for away in (near, 2 * near):
                for turn, how in _orientations():
                    T = pose(_towards(direction) @ turn, away * direction)
                    _pixels, seen = project(camera, transform(T, board.outline_m()))
                    if seen.all():
                        place = "the middle" if row == column == "middle" else f"the {row} {column}"
                        found.append((T, f"a board {away:.1f} m away in {place} of the image, {how}"))
    return found


def _towards(direction: F8) -> F8:
    """Axes of a board that faces the camera from a direction: x to the image's right, z back to the camera."""
    z = -direction
    x = np.cross((0.0, 1.0, 0.0), direction)
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def _orientations() -> list[tuple[F8, str]]:
    found = []
    for degrees in _TILTS_DEG:
        ways = (
            [((0.0, 0.0, 0.0), "facing the camera")]
            if degrees == 0
            else [
                ((-1.0, 0.0, 0.0), f"its top tilted {degrees:.0f} degrees away"),
                ((1.0, 0.0, 0.0), f"its top tilted {degrees:.0f} degrees towards it"),
                ((0.0, 1.0, 0.0), f"its right side turned {degrees:.0f} degrees away"),
                ((0.0, -1.0, 0.0), f"its left side turned {degrees:.0f} degrees away"),
            ]
        )
        found += [(so3_exp(np.radians(degrees) * np.array(axis)), how) for axis, how in ways]
    return found
