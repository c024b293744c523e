"""Where the fit of a board begins: on the rectangle that was measured, or where hands spoil its edges, near it."""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.candidate import Seen
from scanloom.stages.calibrate.cloud.edges import Edges
from scanloom.stages.calibrate.cloud.hits import outside, overlap
from scanloom.stages.calibrate.cloud.misfit import agreement
from scanloom.stages.calibrate.cloud.outline import Rectangle, fits, measured, plane_axes
from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.pose import fitted
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.calibrate.cloud.sweep import Sweep
from scanloom.stages.geometry.se3 import F8, pose

ROUGH_OVERLAP = 0.6
"""Rays that are on both piece and board, of those on either, before the fit."""
_NEAR = 0.06
"""Distance of an edge from the board's outline that counts as near, as a share of its shorter side."""
_NEAR_SHARE = 0.6
_FLUSH = (0.0, -0.5, 0.5)


def without_hands(
    sweep: Sweep, patch: Patch, edges: Edges, rectangle: Rectangle, seen: Seen, settings: CloudSettings
) -> tuple[Rectangle, F8] | None:
    """A measure by the edges near a board of the known size: hands and what else is flush with it spoil the others.

    None where less than three fifths of the edges are near, or the measure still does not fit.
    """
    starts = [T for turned in (0, 1) for T in _flush(patch, rectangle, seen.board, turned)]
    starts = [T for T in starts if overlap(sweep, patch, seen, T) > ROUGH_OVERLAP]
    if not starts:
        return None
    T = fitted(seen, max(starts, key=lambda T: agreement(seen, T)), rounds=2).T_lidar_board
    middle = edges.on + edges.off
    middle = middle / np.linalg.norm(middle, axis=1)[:, None]
    near = np.abs(outside(seen, T, middle, 0.0)) < _NEAR * min(seen.board.board_m)
    along = ~edges.across
    if (near & along).sum() < _NEAR_SHARE * along.sum():
        return None
    better = measured(
        patch,
        Edges(edges.on[near], edges.off[near], edges.left[near], edges.across[near], edges.weight[near]),
    )
    if better is None or not any(fits(better, seen.board, settings.extent_share)):
        return None
    return better, T


def _flush(patch: Patch, rectangle: Rectangle, board: Board, turned: int) -> list[F8]:
    """Boards in the middle of the rectangle, and flush with each of its sides."""
    T = start_of(patch, rectangle, board, turned)
    x, y = (rectangle.size[::-1] if turned else rectangle.size) - board.board_m
    return [T @ pose(np.eye(3), [i * x, j * y, 0.0]) for i in _FLUSH for j in _FLUSH]


def start_of(patch: Patch, rectangle: Rectangle, board: Board, turned: int) -> F8:
    """Pose of a board on the rectangle; `turned`: its first dimension is the rectangle's second."""
    axes = plane_axes(patch)
    angle = rectangle.angle + turned * np.pi / 2
    c, s = np.cos(angle), np.sin(angle)
    R = axes @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    centre = axes[:, :2] @ rectangle.centre - patch.distance_m * patch.normal
    return pose(R, centre - R[:, :2] @ np.asarray(board.offset_m))
