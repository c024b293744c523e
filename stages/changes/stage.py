"""Changes: points of an extended map that its new sessions saw through, gathered and reported.

Each scan at a keyframe of a new session is held against the standing points of the old sessions within 30 m, with the
optimised poses of both. A point is missed when several scans looked through it and hardly any met something there. Then the
old sessions are asked the same of what is missed: where they, too, looked through, something moved past, and only its
remnants were in the map. What stood then and is missed now is gone; it is gathered into objects, and single points are
left out. Nothing is deleted here; what of it leaves the map is for cleaning to say.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from scanloom.schemas.base import Base
from scanloom.schemas.changes import ChangeFiles, Changes
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.tiles import Piece
from scanloom.schemas.trajectory import Poses
from scanloom.stages.changes.looks import AskedTile, Look, ScanFiles, keyframes_of
from scanloom.stages.changes.objects import objects_of
from scanloom.stages.changes.ply import changes_ply
from scanloom.stages.changes.points import corner_of, standing_points
from scanloom.stages.changes.settings import Settings
from scanloom.stages.geometry.se3 import F8

__all__ = ["VERSION", "Settings", "changes"]

VERSION = 1

TILES_AT_ONCE = 400
"""Tiles in memory together; a map of more is gone through in rounds, each with the scans in its reach."""


def changes(
    settings: Settings,
    base: Parts[Base],
    poses: Parts[Poses],
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    pieces: Parts[Piece],
) -> tuple[Changes, ChangeFiles]:
    """What of the old sessions' map the new ones saw through; no rows when there are no old or no new sessions."""
    old = {where["session"] for where, part in base.items() if len(part)}
    looks = keyframes_of(poses, lambda session: session not in old) if old else []
    found, remnants = [np.empty((0, 5))], 0
    if looks:
        scans, before = ScanFiles(deskewed, labels), keyframes_of(poses, old.__contains__)
        for tiles in _rounds(settings, pieces, old, looks):
            gone, moved = _gone(settings, scans, tiles, looks, before)
            found.append(gone)
            remnants += moved
    rows = np.concatenate(found)
    number = objects_of(rows[:, :3], settings.link_m, settings.min_points)
    table = _table(rows, number, remnants, poses, tuple(sorted({look.session for look in looks})))
    return table, ChangeFiles(contents={"changes.ply": changes_ply(table)} if looks else {})


def _gone(
    settings: Settings,
    scans: ScanFiles,
    tiles: Sequence[AskedTile],
    looks: Sequence[Look],
    before: Sequence[Look],
) -> tuple[F8, int]:
    """Rows (n, 5) of x, y, z, through, confirming of the points that are gone, and how many more are remnants."""
    scans.hold_against(settings, tiles, looks)
    missed = [(tile, settings.missed(tile.through, tile.confirming)) for tile in tiles]
    missed = [(tile, rows) for tile, rows in missed if rows.any()]
    again = [AskedTile.of(np.ascontiguousarray(tile.points[rows])) for tile, rows in missed]
    scans.hold_against(settings, again, before)
    found: list[F8] = [np.empty((0, 5))]
    remnants = 0
    for (tile, rows), asked in zip(missed, again, strict=True):
        stood = settings.stood(asked.through, asked.confirming)
        counts = np.column_stack((tile.points, tile.through, tile.confirming))[rows]
        found.append(np.asarray(counts[stood], np.float64))
        remnants += int((~stood).sum())
    return np.concatenate(found), remnants


def _rounds(
    settings: Settings, pieces: Parts[Piece], old: set[str], looks: Sequence[Look]
) -> Iterator[list[AskedTile]]:
    """The tiles of the old sessions within reach of the looks, some hundred at a time."""
    places = np.array([look.place for look in looks])
    numbers: dict[str, list[int]] = {}
    for n, where in enumerate(pieces.coordinates()):
        if where["session"] in old:
            numbers.setdefault(where["tile"], []).append(n)
    size_m = pieces[next(iter(numbers.values()))[0]].tile_size_m if numbers else 0.0
    waiting: list[AskedTile] = []
    for name in sorted(numbers, key=lambda name: corner_of(name, 1.0)):
        low = np.array(corner_of(name, size_m))
        if not AskedTile(low, low + size_m, np.empty((0, 3))).near(places, settings.max_range_m).any():
            continue
        own = [pieces[n] for n in numbers[name]]
        points = standing_points(name, own, settings.thinning_m, settings.clearance_m)
        waiting.append(AskedTile.of(points))
        if len(waiting) == TILES_AT_ONCE:
            yield waiting
            waiting = []
    if waiting:
        yield waiting


def _table(
    rows: F8, number: np.ndarray, remnants: int, poses: Parts[Poses], sessions: tuple[str, ...]
) -> Changes:
    """The points of objects, object by object."""
    order = np.argsort(number, kind="stable")
    order = order[number[order] >= 0]
    first = poses[0] if len(poses) else None
    x, y, z, through, confirming = (np.ascontiguousarray(column) for column in rows[order].T)
    return Changes(
        x_m=x, y_m=y, z_m=z, through=through.astype(np.int32), confirming=confirming.astype(np.int32),
        object_=number[order], remnants=remnants, sessions=sessions,
        frame="" if first is None else first.frame, georeference=None if first is None else first.georeference,
    )  # fmt: skip
