"""Boards in a cloud: flat pieces whose edges have the board's size and whose reflectance has its squares."""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.background import foreground_of
from scanloom.stages.calibrate.cloud.edges import Edges, edges_of
from scanloom.stages.calibrate.cloud.found import CloudBoard, Refused, Search
from scanloom.stages.calibrate.cloud.outline import Rectangle, fits, measured, plane_axes, seen_sides
from scanloom.stages.calibrate.cloud.patches import Patch, patches
from scanloom.stages.calibrate.cloud.pose import (
    PoseFit,
    Seen,
    agreement,
    contrast_of,
    fitted,
    outside,
    seen_of,
    trimmed,
    with_squares,
)
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.calibrate.cloud.sweep import I8, Sweep, sweep_of
from scanloom.stages.geometry.se3 import F8, hat, pose, transform

_LEAST_CONTRAST = 0.35
"""Correlation of the reflectance with the print from which squares count as seen."""
_FAINT_CONTRAST = 0.2
"""The same before the fit."""
_CLEARLY_LESS = 0.3
_CLEAR_CONTRAST = 0.6
"""The same where they stand for a side that cannot be measured."""
_LEAST_OVERLAP = 0.75
"""Rays that are on both piece and board, of those on either."""
_ROUGH_OVERLAP = 0.6
"""The same before the fit."""
_NEAR = 0.06
"""Distance of an edge from the board's outline that counts as near, as a share of its shorter side."""
_NEAR_SHARE = 0.6
_FLUSH = (0.0, -0.5, 0.5)
_SHIFTS = np.linspace(-1.25, 1.25, 11)
"""Squares by which starts are shifted where the edges leave the place open."""


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
    starts = [_start(patch, rectangle, board, turned) for turned, fit in enumerate(ways) if fit]
    if not starts:
        clear = _without_hands(sweep, patch, edges, rectangle, seen, settings)
        if clear is None:
            size, wanted = (_size(value) for value in (rectangle.size, board.board_m))
            return _refused(sweep, patch, f"measures {size}, the board {wanted}")
        rectangle, T = clear
        starts = [T]
    overlap = max(_overlap(sweep, patch, seen, T) for T in starts)
    if overlap < _ROUGH_OVERLAP:
        return _apart(sweep, patch, overlap)
    fit = _best(seen, starts, settings)
    overlap = _overlap(sweep, patch, seen, fit.T_lidar_board)
    if overlap < _LEAST_OVERLAP:
        return _apart(sweep, patch, overlap)
    if settings.reflectance == "require" and not fit.seen.squares:
        return _refused(sweep, patch, "no squares in its reflectance")
    if not seen_sides(rectangle, board).all() and not (fit.seen.squares and fit.contrast > _CLEAR_CONTRAST):
        return _refused(
            sweep, patch, "no clear squares in its reflectance, and only one of its sides can be measured"
        )
    return _cloud_board(sweep, patch, rectangle, fit, overlap)


def _without_hands(
    sweep: Sweep, patch: Patch, edges: Edges, rectangle: Rectangle, seen: Seen, settings: CloudSettings
) -> tuple[Rectangle, F8] | None:
    """A measure by the edges near a board of the known size: hands and what else is flush with it spoil the others.

    None where less than three fifths of the edges are near, or the measure still does not fit.
    """
    starts = [T for turned in (0, 1) for T in _flush(patch, rectangle, seen.board, turned)]
    starts = [T for T in starts if _overlap(sweep, patch, seen, T) > _ROUGH_OVERLAP]
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
    T = _start(patch, rectangle, board, turned)
    x, y = (rectangle.size[::-1] if turned else rectangle.size) - board.board_m
    return [T @ pose(np.eye(3), [i * x, j * y, 0.0]) for i in _FLUSH for j in _FLUSH]


def _apart(sweep: Sweep, patch: Patch, overlap: float) -> Refused:
    return _refused(
        sweep, patch, f"it and the board that fits it best have only {overlap:.0%} of their rays in common"
    )


def _size(pair: object) -> str:
    long, short = sorted(np.asarray(pair, float), reverse=True)
    return f"{long:.2f} x {short:.2f} m"


def _refused(sweep: Sweep, patch: Patch, reason: str) -> Refused:
    points = sweep.points[patch.rays]
    return Refused(points.mean(axis=0), len(points), reason)


def _start(patch: Patch, rectangle: Rectangle, board: Board, turned: int) -> F8:
    """Pose of a board on the rectangle; `turned`: its first dimension is the rectangle's second."""
    axes = plane_axes(patch)
    angle = rectangle.angle + turned * np.pi / 2
    c, s = np.cos(angle), np.sin(angle)
    R = axes @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    centre = axes[:, :2] @ rectangle.centre - patch.distance_m * patch.normal
    return pose(R, centre - R[:, :2] @ np.asarray(board.offset_m))


def _best(seen: Seen, starts: list[F8], settings: CloudSettings) -> PoseFit:
    """The best of the fits from all starts: by edges first, then with the squares where they can be seen."""
    rough = [fitted(seen, T, rounds=2) for T in starts]
    if settings.reflectance != "ignore" and np.ptp(seen.intensity) > 0:
        fit = _by_squares(seen, rough)
        if fit is not None and fit.contrast > _LEAST_CONTRAST:
            return fit
    T = min(rough, key=lambda fit: fit.cost).T_lidar_board
    return fitted(trimmed(seen, T), T)


def _by_squares(seen: Seen, rough: list[PoseFit]) -> PoseFit | None:
    """The fit from where edges and squares agree best; None where nowhere near any squares are to be seen."""
    starts = [T for fit in rough for T in _shifted(seen, fit)]
    found = []
    for squares in (with_squares(seen, True), with_squares(seen, False)):
        T = max(starts, key=lambda T: agreement(squares, T))
        found.append((contrast_of(squares, T), squares, T))
    clearest = max(contrast for contrast, _, _ in found)
    if clearest < _FAINT_CONTRAST:
        return None
    fits_of = [
        fitted(squares, T, rounds=2) for contrast, squares, T in found if contrast > clearest - _CLEARLY_LESS
    ]
    best = max(fits_of, key=lambda fit: agreement(fit.seen, fit.T_lidar_board))
    return fitted(trimmed(best.seen, best.T_lidar_board), best.T_lidar_board)


def _shifted(seen: Seen, fit: PoseFit) -> list[F8]:
    """The start, and others around it within the plane as far as the edges allow."""
    T, size = fit.T_lidar_board, seen.board.square_m
    sigma = np.sqrt(np.diag(fit.covariance)[3:5])
    x, y = (_SHIFTS[np.abs(_SHIFTS) * size <= max(4 * s, 0.3 * size)] for s in sigma)
    return [T @ pose(np.eye(3), [i * size, j * size, 0.0]) for i in x for j in y]


def _overlap(sweep: Sweep, patch: Patch, seen: Seen, T: F8) -> float:
    """Rays both on the piece and on the board, over those on either; those near the outline and hidden ones apart."""
    directions = sweep.direction[patch.window]
    ahead = directions @ T[:3, 2] < -0.02
    off = np.where(ahead, outside(seen, T, directions, 0.0), np.inf)
    slope = np.minimum(directions @ patch.normal, -1e-3)
    hidden = sweep.range_m[patch.window] < -patch.distance_m / slope - 2 * patch.tolerance_m
    margin = 0.02 + seen.width_m
    within, beyond = (off < -margin) & ~hidden, off > margin
    both = (within & patch.inside).sum()
    either = within.sum() + (beyond & patch.inside).sum()
    return float(both / max(either, 1))


def _cloud_board(
    sweep: Sweep, patch: Patch, rectangle: Rectangle, fit: PoseFit, overlap: float
) -> CloudBoard:
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
