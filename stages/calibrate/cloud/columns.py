"""A board of a cloud, from its fit."""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.candidate import Seen
from scanloom.stages.calibrate.cloud.edges import Edges
from scanloom.stages.calibrate.cloud.found import CloudBoard
from scanloom.stages.calibrate.cloud.hits import outside
from scanloom.stages.calibrate.cloud.outline import Rectangle, plane_axes, seen_sides
from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.pose import PoseFit
from scanloom.stages.calibrate.cloud.sweep import I8, Sweep
from scanloom.stages.geometry.se3 import F8, hat, transform


def cloud_board(sweep: Sweep, patch: Patch, rectangle: Rectangle, fit: PoseFit, overlap: float) -> CloudBoard:
    T, seen = fit.T_lidar_board, fit.seen
    board = seen.board
    edge = _edge_columns(seen.edges, seen, T)
    corners = board.corners_m()
    slopes = T[:3, :3] @ np.concatenate(
        (-hat(corners), np.broadcast_to(np.eye(3), (len(corners), 3, 3))), axis=2
    )
    contrast = fit.contrast if seen.squares else 0.0
    return CloudBoard(
        points_m=sweep.points[patch.rays],
        source=sweep.source[patch.rays],
        edge_points_m=edge[0],
        edge_directions=edge[1],
        edge_left=seen.edges.left[~seen.edges.across],
        edge_line=edge[2],
        edge_sigma_m=edge[3],
        T_lidar_board=T,
        covariance=fit.covariance,
        extent_m=_extent(rectangle, board, T, patch),
        rmse_m=fit.rmse_m,
        beam_sigma_m=fit.beam_sigma_m,
        evidence=fit.evidence,
        darker_m=fit.darker_m,
        flare_m=fit.flare_m,
        crossing_m=fit.crossing_m,
        farther_m=fit.farther_m,
        corners_m=transform(T, corners),
        corner_covariance=slopes @ fit.covariance @ np.swapaxes(slopes, 1, 2),
        first_dark=seen.first_dark if seen.squares else None,
        contrast=contrast,
        quality=overlap * (0.5 + 0.5 * max(contrast, 0.0)),
    )


def _edge_columns(edges: Edges, seen: Seen, T: F8) -> tuple[F8, F8, I8, F8]:
    along = ~edges.across
    middle = edges.on[along] + edges.off[along]
    middle /= np.linalg.norm(middle, axis=1)[:, None]
    n = T[:3, 2]
    points = middle * ((n @ T[:3, 3]) / (middle @ n))[:, None]
    flat = (points - T[:3, 3]) @ T[:3, :2] - np.asarray(seen.board.offset_m)
    half = np.asarray(seen.board.board_m) / 2
    # sides in the order of the outline: low y, high x, high y, low x
    distance = np.column_stack(
        (-flat[:, 1] - half[1], flat[:, 0] - half[0], flat[:, 1] - half[1], -flat[:, 0] - half[0])
    )
    on, off = (outside(seen, T, d[along], 0.0) for d in (edges.on, edges.off))
    return points, middle, np.argmax(distance, axis=1), np.sqrt((off - on) ** 2 / 12 + 0.003**2)


def _extent(rectangle: Rectangle, board: Board, T: F8, patch: Patch) -> tuple[float, float]:
    axes = plane_axes(patch)
    first = axes[:, :2] @ np.array([np.cos(rectangle.angle), np.sin(rectangle.angle)])
    size = np.where(seen_sides(rectangle, board), rectangle.size, np.nan)
    along = abs(first @ T[:3, 0]) > abs(first @ T[:3, 1])
    return (float(size[0]), float(size[1])) if along else (float(size[1]), float(size[0]))
