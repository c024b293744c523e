"""Corners as directions: what a pixel sees, what a small turn of that direction is in pixels, and poses from both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.geometry.camera import project, rays
from scanloom.stages.geometry.se3 import F8, hat, inverse, pose, se3_exp, so3_exp, transform

_STEP = 1e-6
_ROUNDS = 50


@dataclass(frozen=True)
class Bearings:
    """Pixels as directions of the camera; errors of a direction in pixels without another projection.

    With d a unit direction near r, the pixel is off by `slopes` (2, 3) times d - r, to the square of the angle between
    them: 1e-3 of the error at one pixel. Far away it still pulls the right way, which a projection does not.
    """

    pixels: F8
    directions: F8
    slopes: F8

    @classmethod
    def of(cls, model: CameraModel, pixels: F8) -> Bearings:
        """Those of pixels (n, 2); NaN for what the lens cannot see."""
        directions = rays(model, pixels)
        columns = []
        for axis in np.eye(3):
            ahead, _ = project(model, directions + _STEP * axis)
            behind, _ = project(model, directions - _STEP * axis)
            columns.append((ahead - behind) / (2 * _STEP))
        return cls(np.asarray(pixels, np.float64), directions, np.stack(columns, axis=-1))

    def errors(self, points: F8) -> tuple[F8, F8]:
        """Errors (n, 2), px, of points (n, 3) of the camera, and their derivatives (n, 2, 3) by the points."""
        distance = np.linalg.norm(points, axis=1)[:, None]
        d = points / distance
        error = np.einsum("nij,nj->ni", self.slopes, d - self.directions)
        across = (np.eye(3) - d[:, :, None] * d[:, None, :]) / distance[:, :, None]
        return error, self.slopes @ across


@dataclass(frozen=True)
class Fit:
    """A pose from one image."""

    T_camera_board: F8
    rms_px: float
    """Scatter of one coordinate of a corner, freedom counted."""


def board_pose(bearings: Bearings, corners: F8) -> Fit | None:
    """Pose of a flat board by its corners (n, 3) in one image, of the two that a flat board always has the better.

    Start: infinitesimal plane-based pose (Collins and Bartoli 2014) on a plane across the board's own direction, so
    that any lens will do; then Gauss-Newton in pixels. None when no pose puts the board before the camera.
    """
    if len(corners) < 4 or not np.isfinite(bearings.directions).all():
        return None
    fits = [refined(bearings, corners, T) for T in _starts(bearings, corners)]
    return min(fits, key=lambda fit: fit.rms_px, default=None)


def _starts(bearings: Bearings, corners: F8) -> list[F8]:
    import cv2

    R = facing(bearings.directions)
    turned = bearings.directions @ R.T
    plane = np.ascontiguousarray(turned[:, None, :2] / turned[:, None, 2:])
    flat = np.ascontiguousarray(corners[:, None, :])
    _, rotations, shifts, _ = cv2.solvePnPGeneric(flat, plane, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    found = []
    for rotation, shift in zip(rotations, shifts):
        T = pose(R.T, np.zeros(3)) @ pose(so3_exp(np.ravel(rotation)), np.ravel(shift))
        if np.isfinite(T).all():
            found.append(T)
    return found


def facing(directions: F8) -> F8:
    """Rotation (3, 3) that turns the middle of the directions (n, 3) onto the optical axis."""
    middle = directions.mean(axis=0)
    middle = middle / np.linalg.norm(middle)
    axis = np.cross(middle, (0.0, 0.0, 1.0))
    sine, cosine = np.linalg.norm(axis), middle[2]
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return so3_exp(axis / sine * np.arctan2(sine, cosine))


def refined(bearings: Bearings, points: F8, T_camera_points: F8) -> Fit:
    """Least squares of the pixels over the pose, by Levenberg and Marquardt, from a start."""
    T, damping = T_camera_points, 1e-4
    cost, H, g = _normal(bearings, points, T)
    for _ in range(_ROUNDS):
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
        ahead = T @ se3_exp(step)
        new_cost, new_H, new_g = _normal(bearings, points, ahead)
        if new_cost <= cost:
            done = np.abs(step).max() < 1e-10 or cost - new_cost < 1e-12 * cost
            T, cost, H, g, damping = ahead, new_cost, new_H, new_g, damping / 10
            if done:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return Fit(T, float(np.sqrt(cost / max(2 * len(points) - 6, 1))))


def _normal(bearings: Bearings, points: F8, T: F8) -> tuple[float, F8, F8]:
    error, slopes = bearings.errors(transform(T, points))
    J = slopes @ np.concatenate(
        (-T[:3, :3] @ hat(points), np.broadcast_to(T[:3, :3], (len(points), 3, 3))), 2
    )
    J, e = J.reshape(-1, 6), error.ravel()
    return float(e @ e), J.T @ J, J.T @ e


def on_board(T_board_camera: F8, directions: F8) -> F8:
    """Where the camera's rays (n, 3) meet the board's plane: (n, 2) in its frame; NaN for rays that go past it."""
    d = directions @ T_board_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = -T_board_camera[2, 3] / d[:, 2]
    met: F8 = T_board_camera[:2, 3] + d[:, :2] * np.where(reach > 0, reach, np.nan)[:, None]
    return met


def turn_and_shift(T: F8, other: F8) -> tuple[float, float]:
    """Angle, rad, and distance, m, between two poses."""
    off = inverse(T) @ other
    cosine = np.clip((np.trace(off[:3, :3]) - 1) / 2, -1.0, 1.0)
    return float(np.arccos(cosine)), float(np.linalg.norm(T[:3, 3] - other[:3, 3]))
