"""Overview: the list of tiles, and the whole map as one cloud."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import IO

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts, columns_of
from scanloom.schemas.tiles import MapFiles, RemovedTile, Tile, TileIndex
from scanloom.stages.geometry.voxels import downsample
from scanloom.stages.tiling import ply
from scanloom.stages.tiling.grid import tile_position

VERSION = 1


class Settings(BaseModel):
    """How coarse the one-file map is."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    map_voxel_size_m: float = Field(0.2, ge=0.01, le=10.0, description="edge of a voxel of map.ply, m")


def overview(
    settings: Settings, tiles: Parts[Tile], removed: Parts[RemovedTile] | None = None
) -> tuple[TileIndex, MapFiles]:
    """List the tiles with bounds and checksums, and write `map.ply` and `removed.ply` tile by tile.

    `removed.ply` has all points that are left out of the map, `map.ply` one point in each coarser voxel. They have float32 coordinates from the origin of the map: steps of 0.06 mm at 1 km and 1 mm at 10 km.

    Raises
    ------
    StageError : the map has no tiles.
    """
    if len(tiles) == 0:
        raise StageError(
            "the map has no tiles: no point was kept",
            next_step="look at the labels and at `tiling.classes`, which says which classes enter the map",
        )
    surveys = [_survey(c["tile"], tile, settings.map_voxel_size_m) for c, tile in tiles.items()]
    index = tile_index(surveys, tiles[0])

    comments = ply.georeference_comments(index.frame, index.georeference, (0.0, 0.0, 0.0))

    def write_map(stream: IO[bytes]) -> None:
        points = sum(len(survey.coarse) for survey in surveys) // ply.VERTEX.itemsize
        stream.write(ply.header(points, ["scanloom map", *comments]))
        stream.writelines(survey.coarse for survey in surveys)

    def write_removed(stream: IO[bytes]) -> None:
        left_out = removed if removed is not None else ()
        stream.write(ply.header(sum(map(len, left_out)), ["scanloom points left out of the map", *comments]))
        stream.writelines(_vertices(tile, np.arange(len(tile))) for tile in left_out)

    return index, MapFiles(contents={"map.ply": write_map, "removed.ply": write_removed})


@dataclass(frozen=True)
class Survey:
    """What the overview keeps of a tile, so that tiles are in memory one by one."""

    name: str
    points: int
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]
    sessions: tuple[str, ...]
    checksum: str
    coarse: bytes
    """Its vertices of `map.ply`."""


def _survey(name: str, tile: Tile, map_voxel_size_m: float) -> Survey:
    low, high = _bounds(tile)
    coarse = _vertices(tile, coarse_picks(tile, map_voxel_size_m))
    return Survey(name, len(tile), low, high, tuple(tile.sessions), checksum(tile), coarse)


def tile_index(surveys: list[Survey], example: Tile) -> TileIndex:
    """One row per tile, ordered by (x, y); grid and georeference are those of any tile."""
    rows = sorted(surveys, key=lambda survey: tile_position(survey.name))
    return TileIndex(
        tile=np.array([row.name for row in rows], object),
        level=np.zeros(len(rows), np.int32),
        points=np.array([row.points for row in rows], np.int64),
        min_m=np.array([row.low_m for row in rows]),
        max_m=np.array([row.high_m for row in rows]),
        sessions=np.array([" ".join(row.sessions) for row in rows], object),
        checksum=np.array([row.checksum for row in rows], object),
        frame=example.frame,
        georeference=example.georeference,
        tile_size_m=example.tile_size_m,
        voxel_size_m=example.voxel_size_m,
    )


def checksum(tile: Tile) -> str:
    """SHA-256 over the bytes of all columns in their declared order, little-endian."""
    digest = hashlib.sha256()
    for name in columns_of(Tile):
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


def _vertices(tile: Tile, picks: NDArray[np.int64]) -> bytes:
    """Vertices of some points of a tile, in the frame of the map."""
    local = np.column_stack((tile.x_m[picks], tile.y_m[picks], tile.z_m[picks]))
    points = (local + np.array(tile.offset_m)).astype(np.float32)
    return ply.vertices(points, tile.intensity[picks], tile.class_[picks])
