"""Scans held against points of the map, tile by tile, with the files that hold them opened only where they are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Poses
from scanloom.stages.changes.rays import I4, fill, judge, new_image
from scanloom.stages.changes.settings import Settings
from scanloom.stages.geometry.se3 import F8, inverse

STOOD = (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC, PointClass.CHANGED)
"""What stood when its session passed, the map's points and what has changed since."""


@dataclass(frozen=True)
class Look:
    """A scan that is held against the map."""

    session: str
    scan_index: int
    T_lidar_world: F8
    place: F8
    """(3,) of the LiDAR in the map, m."""


def keyframes_of(poses: Parts[Poses], wanted: Callable[[str], bool]) -> list[Look]:
    """The keyframes of the wanted sessions."""
    return [
        Look(where["session"], int(scan), np.ascontiguousarray(inverse(T)), T[:3, 3])
        for where, part in poses.items()
        if wanted(where["session"])
        for scan, T in zip(part.scan_index[part.keyframe], part.T_world_lidar[part.keyframe], strict=True)
    ]


@dataclass
class AskedTile:
    """Points (n, 3) of a tile, with how many scans saw through and confirmed each."""

    low: F8
    """(2,) lower corner of their bounds, m."""
    high: F8
    points: F8
    through: I4 = field(init=False)
    confirming: I4 = field(init=False)

    def __post_init__(self) -> None:
        self.through = np.zeros(len(self.points), np.int32)
        self.confirming = np.zeros(len(self.points), np.int32)

    @classmethod
    def of(cls, points: F8) -> AskedTile:
        """Points with their bounds; nobody has looked at them yet."""
        if not len(points):
            return cls(np.zeros(2), np.zeros(2), points)
        return cls(points[:, :2].min(axis=0), points[:, :2].max(axis=0), points)

    def near(self, places: F8, range_m: float) -> NDArray[np.bool_]:
        """Which of `places` (n, 2 or 3) lie within range of the tile's bounds."""
        off = np.maximum(np.maximum(self.low - places[:, :2], places[:, :2] - self.high), 0.0)
        return np.asarray(np.hypot(off[:, 0], off[:, 1]) <= range_m)


class ScanFiles:
    """Deskewed scans with their labels, by session and number."""

    def __init__(self, deskewed: Parts[Deskewed], labels: Parts[Labels]) -> None:
        self._deskewed, self._labels = deskewed, labels
        self._where = [where["session"] for where in deskewed.coordinates()]

    def hold_against(self, settings: Settings, tiles: Sequence[AskedTile], looks: Sequence[Look]) -> None:
        """Add to the counts of the tiles what the scans within reach say of their points."""
        image = new_image()
        limits = settings.limits()
        for look, found, scan, label in self._read(_within_reach(settings, tiles, looks)):
            fill(image, scan.x_m, scan.y_m, scan.z_m, np.isin(label.class_, STOOD))
            for tile in found:
                judge(tile.points, look.T_lidar_world, image, limits, tile.through, tile.confirming)

    def _read(
        self, wanted: Mapping[tuple[str, int], tuple[Look, list[AskedTile]]]
    ) -> Iterator[tuple[Look, list[AskedTile], DeskewedScan, ScanLabels]]:
        """The wanted scans, file by file; a file that holds none of them is not read."""
        numbers: dict[str, list[int]] = {}
        for session, scan_index in wanted:
            numbers.setdefault(session, []).append(scan_index)
        for n, session in enumerate(self._where):
            asked = np.sort(numbers.get(session, []))
            if not len(asked) or not len(self._deskewed[n]):
                continue
            scans = self._deskewed[n]
            first, last = scans[0].scan_index, scans[len(scans) - 1].scan_index
            if np.searchsorted(asked, first) == np.searchsorted(asked, last, side="right"):
                continue
            for scan, label in zip(scans, self._labels[n], strict=True):
                found = wanted.get((session, scan.scan_index))
                if found is not None:
                    yield *found, scan, label


def _within_reach(
    settings: Settings, tiles: Sequence[AskedTile], looks: Sequence[Look]
) -> dict[tuple[str, int], tuple[Look, list[AskedTile]]]:
    """The looks that reach one of the tiles, with these."""
    if not tiles or not looks:
        return {}
    places = np.array([look.place for look in looks])
    near = np.array([tile.near(places, settings.max_range_m) for tile in tiles])
    return {
        (look.session, look.scan_index): (
            look,
            [tile for tile, reached in zip(tiles, near[:, n], strict=True) if reached],
        )
        for n, look in enumerate(looks)
        if near[:, n].any()
    }
