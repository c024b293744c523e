"""Residuals of the calibration graph with their derivatives, many rows at once.

Poses move on the right, T Exp(xi), xi = (rotation, translation), as everywhere.
"""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.rays import Bearings
from scanloom.stages.geometry.se3 import F8, hat, so3_log, transform


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


def cloud_rows(T_lidar_board: F8, T_cloud: F8) -> tuple[F8, F8]:
    """From the board by the cloud to another: (6,) turn, rad, and shift, m, in its frame; derivatives (6, 6)."""
    Rt = T_cloud[:3, :3].T
    turn = so3_log(Rt @ T_lidar_board[:3, :3])
    shift = Rt @ (T_lidar_board[:3, 3] - T_cloud[:3, 3])
    by_board = np.zeros((6, 6))
    by_board[:3, :3] = _right_jacobian_inverse(turn)
    by_board[3:, 3:] = Rt @ T_lidar_board[:3, :3]
    return np.concatenate((turn, shift)), by_board


def _right_jacobian_inverse(w: F8) -> F8:
    """d so3_log(R exp(v)) / dv at v = 0 (Sola et al. 2018, eq. 144)."""
    angle = float(np.linalg.norm(w))
    K = hat(w)
    bend = (
        1.0 / 12.0 if angle < 1e-4 else 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    )
    return np.asarray(np.eye(3) + 0.5 * K + bend * K @ K)


def softened(error: F8, limit: float) -> tuple[F8, F8]:
    """Factors (n, 1) for errors (n, d) in units of their noise, and for their derivatives: Huber's loss as a square.

    The error becomes one whose square is twice the loss rho, and the derivative is scaled so that their product is
    the gradient of rho: a plain least-squares solver then minimises the loss itself.
    """
    size = np.linalg.norm(error, axis=1)
    far = size > limit
    root = np.sqrt(np.where(far, 2 * limit * size - limit**2, 1.0))
    by_error = np.where(far, root / np.where(far, size, 1.0), 1.0)
    by_slope = np.where(far, limit / root, 1.0)
    return by_error[:, None], by_slope[:, None]
