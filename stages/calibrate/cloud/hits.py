"""Where rays meet a board: its plane, its outline, its print.

Clouds are written as if all beams left the origin. In many sensors they do not: those of a VLP-16 cross 42 mm before its
axis (its manual's table of vertical offsets, 11.2 mm at 15 degrees), which few drivers know. A point at elevation e is then
h tan(e) lower than the cloud says, and a board at 2 m looks 2 % too tall.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanloom.stages.calibrate.cloud.candidate import Seen
from scanloom.stages.calibrate.cloud.edges import Edges
from scanloom.stages.calibrate.cloud.outline import outside_by
from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.pattern import dark_share
from scanloom.stages.calibrate.cloud.sweep import I8, Sweep
from scanloom.stages.geometry.se3 import F8

_FACING = 0.35
"""Sine of the angle between a beam and a side from which it crosses it."""
_FLUSH_M = 0.015
"""By how much a ray may pass the outline, beyond the width of the beam, and still be the board's."""


def reach(T: F8, directions: F8, crossing_m: float) -> tuple[F8, F8]:
    """Range (n,) at which rays (n, 3) meet the board's plane, and by how much they start below the origin (n,)."""
    n = T[:3, 2]
    slope = np.minimum(directions @ n, -1e-3)
    low = crossing_m * directions[:, 2] / np.hypot(directions[:, 0], directions[:, 1])
    return (n @ T[:3, 3] + low * n[2]) / slope, low


def crossed(seen: Seen, T: F8, crossing_m: float) -> tuple[tuple[F8, F8], I8]:
    """Of each pair of rays with an edge between: distances (e,), m, and the side of the outline that they cross.

    The first distance is that of the middle from the side, positive outside, the second is how far apart the rays are
    across it. Only sides that face the way from the one to the other count: a beam that runs along a side tells nothing
    of it.
    """
    edges = seen.edges
    on, off = (hits(T, d, crossing_m) for d in (edges.on, edges.off))
    way = off - on
    length = np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)
    middle = (on + off) / 2 - np.asarray(seen.board.offset_m)
    depth = np.sign(way) * middle - np.asarray(seen.board.board_m) / 2
    facing = np.abs(way) > _FACING * length[:, None]
    axis = np.argmax(np.where(facing, depth, -np.inf), axis=1)
    row = np.arange(len(axis))
    positive = way[row, axis] > 0
    side = np.where(axis == 0, np.where(positive, 1, 3), np.where(positive, 2, 0))
    return (depth[row, axis], np.abs(way[row, axis])), side


def hits(T: F8, directions: F8, crossing_m: float) -> F8:
    """Where rays (n, 3) meet the board's plane (n, 2), in its frame."""
    away, low = reach(T, directions, crossing_m)
    hit = directions * away[:, None] - T[:3, 3]
    hit[:, 2] -= low
    out: F8 = hit @ T[:3, :2]
    return out


def outside(seen: Seen, T: F8, directions: F8, crossing_m: float) -> F8:
    """By how much rays (n, 3) pass the board, m; negative on it."""
    board = seen.board
    return outside_by(
        hits(T, directions, crossing_m), np.asarray(board.offset_m), 0.0, np.asarray(board.board_m) / 2
    )


def dark(seen: Seen, T: F8, crossing_m: float) -> F8:
    """Share (n,) of dark print under every ray."""
    blur = np.full(len(seen.direction), max(seen.width_m / 4, 1e-3))
    return dark_share(seen.board, seen.first_dark, hits(T, seen.direction, crossing_m), blur)


def trimmed(seen: Seen, T: F8) -> Seen:
    """Without the rays and edges that are clearly not the board's: hands and what else is flush with it.

    All of it where little would be left: then this is no board.
    """
    limit = seen.width_m + _FLUSH_M
    on = outside(seen, T, seen.direction, 0.0) < limit
    middle = seen.edges.on + seen.edges.off
    near = np.abs(outside(seen, T, middle / np.linalg.norm(middle, axis=1)[:, None], 0.0)) < limit
    near |= seen.edges.across
    if (on.all() and near.all()) or on.mean() < 0.5 or (near & ~seen.edges.across).sum() < 4:
        return seen
    names, beam = np.unique(seen.beam[on], return_inverse=True)
    edges = seen.edges
    return replace(
        seen,
        direction=seen.direction[on],
        range_m=seen.range_m[on],
        intensity=seen.intensity[on],
        beam=beam.astype(np.int64),
        beams=seen.beams[names],
        inner=seen.inner[on],
        edges=Edges(
            edges.on[near], edges.off[near], edges.left[near], edges.across[near], edges.weight[near]
        ),
    )


def overlap(sweep: Sweep, patch: Patch, seen: Seen, T: F8) -> float:
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
