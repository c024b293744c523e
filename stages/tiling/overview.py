"""Overview: the list of tiles, the whole map as one cloud, and its coarsest levels for those who look at all of it."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts, columns_of
from scanloom.schemas.tiles import MapFiles, Overview, RemovedTile, Tile, TileIndex
from scanloom.stages.geometry import ply
from scanloom.stages.geometry.voxels import downsample
from scanloom.stages.tiling.grid import tile_position

VERSION = 2

F8 = NDArray[np.float64]

HELD_BYTES = 1 << 28
"""Of vertices of the map in memory; more wait in a temporary file."""


class Settings(BaseModel):
    """How coarse the one-file map is, and how much of the map is seen at a glance."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    map_voxel_size_m: float = Field(0.2, ge=0.01, le=10.0, description="edge of a voxel of map.ply, m")
    overview_points: int = Field(
        4_000_000,
        ge=1,
        le=100_000_000,
        description="the coarsest levels that together have at most so many points are in the overview, number",
    )


def overview(
    settings: Settings, tiles: Parts[Tile], removed: Parts[RemovedTile] | None = None
) -> tuple[TileIndex, Overview, MapFiles]:
    """List the tiles with bounds and checksums, gather their coarsest levels, write `map.ply` and `removed.ply`.

    `removed.ply` has all points that are left out of the map, `map.ply` one point in each coarser voxel, with colours where cameras saw any. They have
    float32 coordinates from the origin of the map: steps of 0.06 mm at 1 km and 1 mm at 10 km. Tiles are read once and
    are in memory one by one; of all of them only what the overview holds.

    Raises
    ------
    StageError : the map has no tiles.
    """
    if len(tiles) == 0:
        raise StageError(
            "the map has no tiles: no point was kept",
            next_step="look at the labels and at `tiling.classes`, which says which classes enter the map",
        )
    surveys: list[Survey] = []
    coarsest = _Coarsest(settings.overview_points)
    spool = tempfile.SpooledTemporaryFile(HELD_BYTES)  # noqa: SIM115  it lives until map.ply is written
    coloured = False
    for where, tile in tiles.items():
        surveys.append(_survey(where["tile"], tile))
        coarsest.add(where["tile"], tile)
        spool.write(_vertices(tile, coarse_picks(tile, settings.map_voxel_size_m), ply.COLOURED))
        coloured |= bool(tile.views.any())
    index = tile_index(surveys, tiles[0])
    comments = ply.georeference_comments(index.frame, index.georeference, (0.0, 0.0, 0.0))

    def write_map(stream: IO[bytes]) -> None:
        vertex = ply.COLOURED if coloured else ply.VERTEX
        stream.write(ply.header(spool.tell() // ply.COLOURED.itemsize, ["scanloom map", *comments], vertex))
        stream.writelines(_contents(spool, coloured))

    def write_removed(stream: IO[bytes]) -> None:
        left_out = removed if removed is not None else ()
        stream.write(ply.header(sum(map(len, left_out)), ["scanloom points left out of the map", *comments]))
        stream.writelines(_vertices(tile, np.arange(len(tile)), ply.VERTEX) for tile in left_out)

    return (
        index,
        coarsest.gathered(index),
        MapFiles(contents={"map.ply": write_map, "removed.ply": write_removed}),
    )


def _contents(spool: IO[bytes], coloured: bool) -> Iterator[bytes]:
    """All vertices that were written to a file, which is left at its end; with their colours, or without."""
    spool.seek(0)
    while block := spool.read(ply.COLOURED.itemsize << 20):
        yield block if coloured else ply.without_colour(block)


@dataclass(frozen=True)
class Survey:
    """What the list of tiles says of one."""

    name: str
    level: NDArray[np.int32]
    """(levels,) that have points, coarsest first; of an empty tile the finest."""
    points: NDArray[np.int64]
    low_m: F8
    high_m: F8
    sessions: tuple[str, ...]
    checksum: list[str]


def _survey(name: str, tile: Tile) -> Survey:
    levels = tile.level.astype(np.int32) if len(tile) else np.zeros(1, np.int32)
    starts = np.flatnonzero(np.diff(levels, prepend=-1))
    runs = [tile.take(slice(a, b)) for a, b in zip(starts, [*starts[1:], len(tile)])]
    low, high = zip(*map(_bounds, runs))
    return Survey(
        name,
        levels[starts],
        np.array([len(run) for run in runs], np.int64),
        np.array(low, float).reshape(-1, 3),
        np.array(high, float).reshape(-1, 3),
        tuple(tile.sessions),
        [checksum(run) for run in runs],
    )


def tile_index(surveys: list[Survey], example: Tile) -> TileIndex:
    """Rows of each tile and level, ordered by (x, y); grid and georeference are those of any tile."""
    tiles = sorted(surveys, key=lambda survey: tile_position(survey.name))
    repeats = [len(tile.level) for tile in tiles]
    named = [tile.name for tile in tiles]
    sessions = [" ".join(tile.sessions) for tile in tiles]
    return TileIndex(
        tile=np.repeat(np.array(named, object), repeats),
        level=np.concatenate([tile.level for tile in tiles]),
        points=np.concatenate([tile.points for tile in tiles]),
        first_row=np.concatenate([np.cumsum(tile.points) - tile.points for tile in tiles]),
        min_m=np.concatenate([tile.low_m for tile in tiles]),
        max_m=np.concatenate([tile.high_m for tile in tiles]),
        sessions=np.repeat(np.array(sessions, object), repeats),
        checksum=np.array([digest for tile in tiles for digest in tile.checksum], object),
        frame=example.frame,
        georeference=example.georeference,
        tile_size_m=example.tile_size_m,
        voxel_size_m=example.voxel_size_m,
    )


@dataclass
class _Coarsest:
    """The coarsest levels of the tiles so far that have no more than `most` points together; the coarsest of all always."""

    most: int
    finest: int = 0
    """Level below which nothing is kept."""
    held: list[tuple[str, Tile]] = field(default_factory=list)
    points: int = 0

    def add(self, name: str, tile: Tile) -> None:
        kept = tile.take(tile.level >= self.finest)
        self.held.append((name, kept))
        self.points += len(kept)
        while self.points > self.most and any((tile.level > self.finest).any() for _, tile in self.held):
            self.finest += 1
            self.held = [(name, tile.take(tile.level >= self.finest)) for name, tile in self.held]
            self.points = sum(len(tile) for _, tile in self.held)

    def gathered(self, index: TileIndex) -> Overview:
        """As one table, sessions numbered for the whole map."""
        number = {name: i for i, name in enumerate(index.names)}
        held = sorted(
            ((number[name], tile) for name, tile in self.held if len(tile)), key=lambda pair: pair[0]
        )
        sessions = sorted({session for _, tile in held for session in tile.sessions})
        columns = [_renumbered(tile, sessions) for _, tile in held]
        joined: dict[str, Any] = {
            name: np.concatenate([each[name] for each in columns])
            if columns
            else getattr(self.held[0][1], name)
            for name in columns_of(Tile)
        }
        tile = np.repeat(np.array([i for i, _ in held], np.int32), [len(tile) for _, tile in held])
        return _by_level(
            Overview(
                **joined,
                tile=tile,
                **{**self.held[0][1].attributes, "offset_m": (0.0, 0.0, 0.0), "sessions": tuple(sessions)},
            )
        )


def _renumbered(tile: Tile, sessions: list[str]) -> dict[str, Any]:
    """Columns of a tile, its sessions numbered as in `sessions`."""
    columns = {name: getattr(tile, name) for name in columns_of(Tile)}
    number = np.array([sessions.index(name) for name in tile.sessions], np.uint16)
    return {**columns, "session": number[tile.session] if len(number) else tile.session}


def _by_level(cloud: Overview) -> Overview:
    return cloud.take(np.argsort(cloud.level.max(initial=0) - cloud.level, kind="stable"))


def checksum(tile: Tile) -> str:
    """SHA-256 over the bytes of all columns in their declared order, little-endian."""
    digest = hashlib.sha256()
    for name in columns_of(type(tile)):
        digest.update(np.ascontiguousarray(getattr(tile, name)).data)
    return digest.hexdigest()


def _bounds(tile: Tile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    offset = np.array(tile.offset_m)
    if len(tile) == 0:
        return offset, offset
    axes = (tile.x_m, tile.y_m, tile.z_m)
    low = np.array([axis.min() for axis in axes], float)
    return offset + low, offset + np.array([axis.max() for axis in axes], float)


def coarse_picks(tile: Tile, voxel_size_m: float) -> NDArray[np.int64]:
    """Indices of the tile's points that are the first of their coarse voxel, in order."""
    if voxel_size_m <= tile.voxel_size_m:
        return np.arange(len(tile))
    return downsample(np.column_stack((tile.x_m, tile.y_m, tile.z_m)), voxel_size_m)


def _vertices(tile: Tile, picks: NDArray[np.int64], vertex: np.dtype[Any]) -> bytes:
    """Vertices of some points of a tile, in the frame of the map."""
    local = np.column_stack((tile.x_m[picks], tile.y_m[picks], tile.z_m[picks]))
    points = (local + np.array(tile.offset_m)).astype(np.float32)
    colour = tile.colour[picks] if vertex == ply.COLOURED else None
    return ply.vertices(points, tile.intensity[picks], tile.class_[picks], colour)
