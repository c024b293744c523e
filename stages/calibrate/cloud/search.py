"""Boards in a cloud: flat pieces whose edges have the board's size and whose reflectance has its squares."""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.background import foreground_of
from scanloom.stages.calibrate.cloud.candidate import seen_of
from scanloom.stages.calibrate.cloud.columns import cloud_board
from scanloom.stages.calibrate.cloud.edges import edges_of
from scanloom.stages.calibrate.cloud.fits import best_fit
from scanloom.stages.calibrate.cloud.found import CloudBoard, Refused, Search
from scanloom.stages.calibrate.cloud.hits import overlap
from scanloom.stages.calibrate.cloud.outline import fits, measured, seen_sides
from scanloom.stages.calibrate.cloud.patches import Patch, patches
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.calibrate.cloud.starts import ROUGH_OVERLAP, start_of, without_hands
from scanloom.stages.calibrate.cloud.sweep import I8, Sweep, sweep_of
from scanloom.stages.geometry.se3 import F8

_CLEAR_CONTRAST = 0.6
"""Correlation of the reflectance with the print where squares stand for a side that cannot be measured."""
_LEAST_OVERLAP = 0.75
"""Rays that are on both piece and board, of those on either."""


def find_boards(
    points: F8,
    intensity: F8,
    ring: I8 | None,
    board: Board,
    background: F8 | None = None,
    settings: CloudSettings | None = None,
) -> list[CloudBoard]:
    """Boards in a cloud, the best first; see `search_boards`."""
    return list(search_boards(points, intensity, ring, board, background, settings).boards)


def search_boards(
    points: F8,
    intensity: F8,
    ring: I8 | None,
    board: Board,
    background: F8 | None = None,
    settings: CloudSettings | None = None,
) -> Search:
    """Boards in a cloud (n, 3), m, with reflectance (n,) of any scale and the beam (n,) of each point if it is known.

    `background` (k, 3) are points of the scene without the board (`static_points`). The cloud is one scan, or several
    of a sensor that stands still, about the sensor's origin.
    """
    chosen = settings or CloudSettings()
    foreground = (
        np.ones(len(points), np.bool_)
        if background is None
        else foreground_of(points, background, chosen.static_m)
    )
    if not (np.isfinite(points).all(axis=1) & (np.abs(points) > chosen.min_range_m).any(axis=1)).any():
        return Search((), ())
    sweep = sweep_of(
        np.asarray(points, np.float64), np.asarray(intensity), ring, foreground, chosen.min_range_m
    )
    found: list[CloudBoard] = []
    refused: list[Refused] = []
    if len(sweep.range_m):
        for patch in patches(sweep, board, chosen):
            result = _judged(sweep, patch, board, chosen)
            if isinstance(result, Refused):
                refused.append(result)
            else:
                found.append(result)
    found, others = _distinct(found, board)
    refused = sorted(refused + others, key=lambda piece: -piece.points)
    return Search(tuple(found), tuple(refused))


def _judged(sweep: Sweep, patch: Patch, board: Board, settings: CloudSettings) -> CloudBoard | Refused:
    """The board a piece is, or why it is none."""
    edges = edges_of(sweep, patch)
    rectangle = measured(patch, edges)
    if rectangle is None:
        return _refused(sweep, patch, "too few of its edges can be seen")
    seen = seen_of(sweep, patch, edges, board, settings)
    ways = fits(rectangle, board, settings.extent_share)
    starts = [start_of(patch, rectangle, board, turned) for turned, fit in enumerate(ways) if fit]
    if not starts:
        clear = without_hands(sweep, patch, edges, rectangle, seen, settings)
        if clear is None:
            size, wanted = (_size(value) for value in (rectangle.size, board.board_m))
            return _refused(sweep, patch, f"measures {size}, the board {wanted}")
        rectangle, T = clear
        starts = [T]
    share = max(overlap(sweep, patch, seen, T) for T in starts)
    if share < ROUGH_OVERLAP:
        return _apart(sweep, patch, share)
    fit = best_fit(seen, starts, settings)
    share = overlap(sweep, patch, seen, fit.T_lidar_board)
    if share < _LEAST_OVERLAP:
        return _apart(sweep, patch, share)
    if settings.reflectance == "require" and not fit.seen.squares:
        return _refused(sweep, patch, "no squares in its reflectance")
    if not seen_sides(rectangle, board).all() and not (fit.seen.squares and fit.contrast > _CLEAR_CONTRAST):
        return _refused(
            sweep, patch, "no clear squares in its reflectance, and only one of its sides can be measured"
        )
    return cloud_board(sweep, patch, rectangle, fit, share)


def _apart(sweep: Sweep, patch: Patch, share: float) -> Refused:
    return _refused(
        sweep, patch, f"it and the board that fits it best have only {share:.0%} of their rays in common"
    )


def _size(pair: object) -> str:
    long, short = sorted(np.asarray(pair, float), reverse=True)
    return f"{long:.2f} x {short:.2f} m"


def _refused(sweep: Sweep, patch: Patch, reason: str) -> Refused:
    points = sweep.points[patch.rays]
    return Refused(points.mean(axis=0), len(points), reason)


def _distinct(found: list[CloudBoard], board: Board) -> tuple[list[CloudBoard], list[Refused]]:
    """The best of those in the same place, in the order of quality; without squares only where none has them."""
    out: list[CloudBoard] = []
    refused: list[Refused] = []
    squares = any(one.first_dark is not None for one in found)
    for one in sorted(found, key=lambda b: -b.quality):
        centre = one.T_lidar_board[:3, 3]
        if any(np.linalg.norm(centre - b.T_lidar_board[:3, 3]) < min(board.board_m) / 2 for b in out):
            continue
        if squares and one.first_dark is None:
            refused.append(
                Refused(centre, len(one.points_m), "no squares in its reflectance, unlike in that of another")
            )
            continue
        out.append(one)
    return out, refused
