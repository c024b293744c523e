"""Changes: points of an extended map that its new sessions saw through. They are reported, never deleted.

Each scan at a keyframe of a new session is held against the standing points of the old sessions within 40 m, with the
optimised poses of both. A point is gone when several scans looked through it and hardly any met something there; what
is gone is gathered into objects, and single points are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.base import Base
from scanloom.schemas.changes import ChangeFiles, Changes
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.tiles import Piece
from scanloom.schemas.trajectory import Poses
from scanloom.stages.changes.objects import objects_of
from scanloom.stages.changes.ply import changes_ply
from scanloom.stages.changes.points import corner_of, standing_points
from scanloom.stages.changes.rays import I4, fill, judge, new_image
from scanloom.stages.changes.settings import Settings
from scanloom.stages.geometry.se3 import F8, inverse

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
    looks = _looks(poses, old) if old else []
    if not looks:
        return _table(np.empty((0, 3)), np.empty((0, 2), np.int32), np.empty(0, np.int32), poses, ())
    asked = _Reach(pieces, old, looks, settings)
    found, counts = [np.empty((0, 3))], [np.empty((0, 2), np.int32)]
    for tiles in asked.rounds():
        _look_at(tiles, looks, deskewed, labels, settings)
        for tile in tiles:
            gone = tile.gone(settings)
            found.append(tile.points[gone])
            counts.append(np.column_stack((tile.through, tile.confirming))[gone])
    points, seen = np.concatenate(found), np.concatenate(counts)
    number = objects_of(points, settings.link_m, settings.min_points)
    kept = np.lexsort((np.arange(len(number)), number))
    kept = kept[number[kept] >= 0]
    new = tuple(sorted({look.session for look in looks}))
    return _table(points[kept], seen[kept], number[kept], poses, new)


@dataclass(frozen=True)
class _Look:
    """A scan of a new session that is held against the map."""

    session: str
    scan_index: int
    T_lidar_world: F8
    place: F8


@dataclass
class _AskedTile:
    """Standing points (n, 3) of a tile with how many scans saw through and confirmed each."""

    corner: tuple[float, float]
    size_m: float
    points: F8
    through: I4
    confirming: I4

    def near(self, place: F8, range_m: float) -> bool:
        """Whether some of the tile lies within range."""
        off = [max(c - p, 0.0, p - c - self.size_m) for c, p in zip(self.corner, place[:2], strict=True)]
        return float(np.hypot(*off)) <= range_m

    def gone(self, settings: Settings) -> np.ndarray:
        return (self.through >= settings.min_scans) & (
            self.confirming <= settings.max_confirming * self.through
        )


def _looks(poses: Parts[Poses], old: set[str]) -> list[_Look]:
    """The keyframes of the new sessions."""
    return [
        _Look(where["session"], int(part.scan_index[k]), np.ascontiguousarray(inverse(T)), T[:3, 3])
        for where, part in poses.items()
        if where["session"] not in old
        for k, T in zip(np.flatnonzero(part.keyframe), part.T_world_lidar[part.keyframe], strict=True)
    ]


class _Reach:
    """The tiles of the old sessions within reach of the looks, in rounds."""

    def __init__(
        self, pieces: Parts[Piece], old: set[str], looks: Sequence[_Look], settings: Settings
    ) -> None:
        self._pieces = pieces
        self._old = old
        self._places = np.array([look.place[:2] for look in looks])
        self._settings = settings
        self._of_tile: dict[str, list[int]] = {}
        for n, where in enumerate(pieces.coordinates()):
            if where["session"] in old:
                self._of_tile.setdefault(where["tile"], []).append(n)

    def rounds(self) -> Iterator[list[_AskedTile]]:
        waiting: list[_AskedTile] = []
        for name in sorted(self._of_tile, key=_grid_place):
            tile = self._asked(name)
            if tile is not None:
                waiting.append(tile)
            if len(waiting) == TILES_AT_ONCE:
                yield waiting
                waiting = []
        if waiting:
            yield waiting

    def _asked(self, name: str) -> _AskedTile | None:
        """The tile, unless no scan comes near it; its size is known from its first piece only."""
        numbers = self._of_tile[name]
        first: Piece = self._pieces[numbers[0]]
        size = first.tile_size_m
        corner = corner_of(name, size)
        off = np.maximum(
            np.maximum(np.array(corner) - self._places, self._places - np.array(corner) - size), 0.0
        )
        if not (np.hypot(*off.T) <= self._settings.max_range_m).any():
            return None
        rest = [self._pieces[n] for n in numbers[1:]]
        points = standing_points(name, [first, *rest], self._settings.thinning_m)
        none = np.zeros(len(points), np.int32)
        return _AskedTile(corner, size, points, none, none.copy())


def _grid_place(name: str) -> tuple[int, int]:
    x, y = name.split("_")
    return int(x), int(y)


def _look_at(
    tiles: Sequence[_AskedTile],
    looks: Sequence[_Look],
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    settings: Settings,
) -> None:
    """Hold every scan in reach of the tiles against their points."""
    image = new_image()
    limits = np.array(
        [
            settings.max_range_m, settings.margin_m, settings.margin_share, settings.ray_m, settings.guard_m,
            settings.confirm_m,
        ]
    )  # fmt: skip
    reach = settings.max_range_m
    near = {
        (look.session, look.scan_index): (look, found)
        for look in looks
        if (found := [tile for tile in tiles if tile.near(look.place, reach)])
    }
    for (look, found), scan, label in _scans(near, deskewed, labels):
        static = np.isin(label.class_, (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC))
        fill(image, scan.x_m, scan.y_m, scan.z_m, static)
        for tile in found:
            judge(tile.points, look.T_lidar_world, image, limits, tile.through, tile.confirming)


def _scans(
    near: Mapping[tuple[str, int], tuple[_Look, list[_AskedTile]]],
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
) -> Iterator[tuple[tuple[_Look, list[_AskedTile]], DeskewedScan, ScanLabels]]:
    """The scans that are asked for, from the files that hold one of them."""
    wanted = {session for session, _ in near}
    both = zip(deskewed.coordinates(), range(len(deskewed)), strict=True)
    for where, n in both:
        if where["session"] not in wanted:
            continue
        for scan, label in zip(deskewed[n], labels[n], strict=True):
            asked = near.get((where["session"], scan.scan_index))
            if asked is not None:
                yield asked, scan, label


def _table(
    points: F8, seen: I4, number: I4, poses: Parts[Poses], sessions: tuple[str, ...]
) -> tuple[Changes, ChangeFiles]:
    frame = poses[0].frame if len(poses) else ""
    origin = poses[0].georeference if len(poses) else None
    x, y, z = (np.ascontiguousarray(points[:, axis]) for axis in range(3))
    through, confirming = (np.ascontiguousarray(seen[:, k]) for k in range(2))
    table = Changes(x, y, z, through, confirming, number, sessions, frame, origin)
    return table, ChangeFiles(contents={"changes.ply": changes_ply(table)} if sessions else {})
