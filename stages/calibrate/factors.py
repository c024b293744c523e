"""Residuals of the calibration graph with their derivatives, many rows at once, in units of their noise.

Poses move on the right, T Exp(xi), xi = (rotation, translation), as everywhere.
"""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.rays import Bearings
from scanloom.stages.geometry.se3 import F8, hat, transform

_GRAZING = 0.05
"""Least cosine between a ray and a board's normal that a residual divides by."""


def corner_rows(T_lidar_camera: F8, T_lidar_board: F8, corners: F8, bearings: Bearings) -> tuple[F8, F8, F8]:
    """Reprojection errors (n, 2), px, of corners (n, 3) of the board; derivatives (n, 2, 6) by camera and board."""
    R_camera, R_board = T_lidar_camera[:3, :3], T_lidar_board[:3, :3]
    q = (transform(T_lidar_board, corners) - T_lidar_camera[:3, 3]) @ R_camera
    error, slopes = bearings.errors(q)
    unit = np.broadcast_to(np.eye(3), (len(corners), 3, 3))
    by_camera = slopes @ np.concatenate((hat(q), -unit), axis=2)
    R = R_camera.T @ R_board
    by_board = slopes @ (R @ np.concatenate((-hat(corners), unit), axis=2))
    return error, by_camera, by_board


def plane_rows(T_lidar_board: F8, points: F8) -> tuple[F8, F8]:
    """How much farther along their own rays the board is than the points (n, 3) say: (n,), m, and by board (n, 6)."""
    R, t = T_lidar_board[:3, :3], T_lidar_board[:3, 3]
    directions = points / np.linalg.norm(points, axis=1)[:, None]
    u = directions @ R
    slant = _off_grazing(u[:, 2])
    s = (t - points) @ R
    gap = s[:, 2] / slant
    by_turn = (np.cross(s, (0.0, 0.0, 1.0)) - gap[:, None] * np.cross(u, (0.0, 0.0, 1.0))) / slant[:, None]
    by_shift = np.zeros((len(points), 3))
    by_shift[:, 2] = 1.0 / slant
    return gap, np.concatenate((by_turn, by_shift), axis=1)


def line_rows(T_lidar_board: F8, points: F8, normals: F8, offsets: F8) -> tuple[F8, F8]:
    """Distance (n,), m, on the board of rays through points (n, 3) from lines of its plane, and by board (n, 6).

    A line is all x with normal . x = offset; normals (n, 2) are unit vectors in the board's frame.
    """
    R, t = T_lidar_board[:3, :3], T_lidar_board[:3, 3]
    u = points / np.linalg.norm(points, axis=1)[:, None] @ R
    slant = _off_grazing(u[:, 2])
    s = t @ R
    reach = s[2] / slant
    x = reach[:, None] * u - s
    distance = (normals * x[:, :2]).sum(axis=1) - offsets
    # In the board's own axes u turns by hat(u) w and s by hat(s) w + v; x = (s_z / u_z) u - s
    turn_u, turn_s = hat(u), hat(s)
    by_reach = (turn_s[2] - reach[:, None] * turn_u[:, 2]) / slant[:, None]
    by_turn = u[:, :, None] * by_reach[:, None, :] + reach[:, None, None] * turn_u - turn_s
    by_shift = u[:, :, None] * (np.array([0.0, 0.0, 1.0]) / slant[:, None])[:, None, :] - np.eye(3)
    J = np.concatenate((by_turn, by_shift), axis=2)
    return distance, np.einsum("ni,nij->nj", normals, J[:, :2])


def _off_grazing(slant: F8) -> F8:
    return np.where(np.abs(slant) < _GRAZING, np.copysign(_GRAZING, slant), slant)


def softened(error: F8, limit: float) -> tuple[F8, F8]:
    """Factors (n, 1) for errors (n, d) in units of their noise, and for their derivatives: Huber's loss as a square.

    The error becomes one whose square is twice the loss rho, and the derivative is scaled so that their product is
    the gradient of rho: a plain least-squares solver then minimises the loss itself.
    """
    size = np.linalg.norm(error, axis=1)
    far = size > limit
    root = np.sqrt(np.where(far, 2 * limit * size - limit**2, 1.0))
    safe = np.where(far, size, 1.0)
    by_error = np.where(far, root / safe, 1.0)
    by_slope = np.where(far, limit / root, 1.0)
    return by_error[:, None], by_slope[:, None]
