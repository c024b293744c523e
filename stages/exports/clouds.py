"""Points of a map on their way into a file: tile after tile, in the coordinates of the export."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.tiles import RemovedTile, Tile
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource, opened

F8 = NDArray[np.float64]

REMOVED = "-removed"
"""Ends the name of a cloud of what was left out of a tile."""


@dataclass(frozen=True)
class Cloud:
    """Some points of one tile, placed."""

    name: str
    """Of the tile; that of what was left out of it ends in `REMOVED`."""
    xyz: F8
    """(n, 3) in the export's system, m."""
    tile: Tile
    """All their columns."""
    axes: F8
    """Rotation (3, 3) of directions of the map's frame into the export's."""

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def normals(self) -> NDArray[np.float32]:
        """Unit normals (n, 3) along the export's axes; zeros where there is no surface."""
        turned = self.tile.normal.astype(np.float32) @ self.axes.T.astype(np.float32)
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        return np.asarray(turned / np.maximum(length, 1.0), np.float32)

    def take(self, rows: NDArray[np.int64]) -> Cloud:
        return replace(self, xyz=self.xyz[rows], tile=self.tile.take(rows))


def points_of(source: MapSource, options: Options) -> int:
    """How many points `clouds` gives: what the files hold, since headers of formats must agree with what follows."""
    files = (part_file(source, name) for name in part_names(source, options))
    return sum(len(columns_of_file(path, [])) for path in files)


def columns_of_file(path: Path, names: list[str]) -> pa.Table:
    """Some columns of one of the map's files, without the check of the others; none of them for the number of rows alone.

    Raises
    ------
    InvalidInput : the file is missing or damaged.
    """
    try:
        return pq.read_table(path, columns=names)
    except (OSError, pa.ArrowException) as error:
        raise InvalidInput(
            f"cannot be read ({error})",
            where=str(path),
            next_step="the folder of the map is damaged: run `scanloom map` again",
        ) from error


def clouds(source: MapSource, projector: Projector, options: Options) -> Iterator[Cloud]:
    """All points of an export, one tile in memory at a time."""
    for name in part_names(source, options):
        yield cloud_of(source, projector, name)


def cloud_of(source: MapSource, projector: Projector, name: str) -> Cloud:
    """One of `part_names`, placed."""
    tile = part(source, name)
    source.passed()
    return Cloud(name, projector.tile(tile), tile, projector.axes(tile.offset_m))


def part_names(source: MapSource, options: Options) -> list[str]:
    """Tiles, and what was left out of each, in the order of `clouds`."""
    return source.tile_names + [f"{path.stem}{REMOVED}" for path in _removed_files(source, options)]


def part_file(source: MapSource, name: str) -> Path:
    """Where one of `part_names` lies."""
    if name.endswith(REMOVED):
        return source.folder / "removed" / f"{name.removesuffix(REMOVED)}.parquet"
    return source.folder / "tiles" / f"{name}.parquet"


def part_boxes(source: MapSource, options: Options) -> dict[str, tuple[F8, F8]]:
    """Lowest and highest corner, in the map's frame, of the points of each of `part_names` that has any."""
    index = source.index.filled
    boxes = {
        name: (index.min_m[rows].min(axis=0), index.max_m[rows].max(axis=0))
        for name, rows in index.by_tile().items()
    }
    for path in _removed_files(source, options):
        tile = RemovedTile.open(path)
        if len(tile):
            local = np.array([[axis.min(), axis.max()] for axis in (tile.x_m, tile.y_m, tile.z_m)], float)
            low, high = local.T + np.array(tile.offset_m)
            boxes[f"{path.stem}{REMOVED}"] = (low, high)
    return boxes


def box_of(source: MapSource, projector: Projector, options: Options) -> F8:
    """Lowest and highest corner (2, 3) of a box around all points of an export, m.

    It encloses the corners of the tiles' own boxes, hence reaches over the points by as much as the axes are turned.
    """
    boxes = list(part_boxes(source, options).values())
    if not boxes:
        return np.zeros((2, 3))
    corners = projector.corners([low for low, _ in boxes], [high for _, high in boxes])
    return np.stack((corners.min(axis=0), corners.max(axis=0)))


def part(source: MapSource, name: str) -> Tile:
    """One of `part_names`; sessions are numbered as in `session_names`, not as in the tile."""
    kind = RemovedTile if name.endswith(REMOVED) else Tile
    tile = opened(kind, part_file(source, name))
    everyone = session_names(source)
    numbers = np.array([everyone.index(session) for session in tile.sessions] or [0], np.uint16)
    return replace(tile, session=numbers[tile.session], sessions=everyone)


def session_names(source: MapSource) -> tuple[str, ...]:
    """Sessions of the map in the order of its header, then those that only tiles still name."""
    listed = [str(session["name"]) for session in source.header.get("sessions", [])]
    met = sorted({name for names in source.index.sessions for name in str(names).split()})
    return tuple(dict.fromkeys(listed + met))


def _removed_files(source: MapSource, options: Options) -> list[Path]:
    return sorted((source.folder / "removed").glob("*.parquet")) if options.removed else []


def round_offset_m(source: MapSource, projector: Projector) -> F8:
    """A round place near the middle of the map in the export's system (3,), m: what float32 coordinates start from.

    Whole hundreds of metres, so that single precision keeps a millimetre up to 8 km away.
    """
    if not source.points:
        return np.zeros(3)
    middle = source.index.bounds_m.mean(axis=0)
    return np.asarray(np.round(projector.project(middle)[0] / 100.0) * 100.0)
