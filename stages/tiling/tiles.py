"""Tiles: pieces of all chunks and sessions merged into the voxel-filtered points of one tile."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts, columns_of
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT, RANK_SHIFT, Piece, RemovedTile, Tile, TileFiles
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.tiling import ply
from scanloom.stages.tiling.grid import tile_position

VERSION = 1

ROWS_AT_ONCE = 150_000
"""Voxels that wait to be merged."""


class Settings(BaseModel):
    """Which voxels become points of the map."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_points: int = Field(1, ge=1, le=1000, description="points a voxel needs to enter the map")
    min_scans: int = Field(
        1, ge=1, le=1000, description="different scans of one chunk or more that must hit a voxel"
    )


def tiles(settings: Settings, pieces: Parts[Piece]) -> tuple[Tile, RemovedTile, TileFiles]:
    """Merge the pieces of one tile: the mean point, mean intensity and majority class of every voxel.

    What is left out of the map is averaged likewise, class by class. The sums are exact (see `voxel_sums`), hence the tile
    does not depend on the order of the pieces.

    Raises
    ------
    StageError : there are no pieces, or they belong to different grids or tiles.
    """
    name, sessions = _identity(pieces)
    merged = merge_all(name, pieces)
    first_out = int(np.searchsorted(merged.voxel, 1 << RANK_SHIFT))
    of_map, left_out = merged.take(slice(0, first_out)), merged.take(slice(first_out, None))
    kept = of_map.take((of_map.count >= settings.min_points) & (of_map.scan_count >= settings.min_scans))
    tile = Tile(**_average(kept, name, sessions), class_=_scenery(kept))
    removed = RemovedTile(**_average(left_out, name, sessions), class_=_left_out(left_out))
    return tile, removed, TileFiles(contents={"tile.ply": tile_ply(tile)})


def merge_all(name: str, pieces: Iterable[Piece]) -> Piece:
    """Merge piece after piece, so that a place passed a hundred times takes no more memory than one passed twice.

    Raises
    ------
    StageError : the pieces were made with different grids or georeferences.
    """
    waiting: list[Piece] = []
    for piece in pieces:
        if waiting and waiting[0].attributes != piece.attributes:
            raise StageError(
                "the pieces of this tile were made with different grids or georeferences",
                where=f"tile {name}",
                next_step="run tiling again for all sessions with the same settings",
            )
        waiting.append(piece)
        if sum(map(len, waiting[1:])) > len(waiting[0]) // 4 + ROWS_AT_ONCE:
            waiting = [merge(waiting)]
    return merge(waiting)


def merge(pieces: list[Piece]) -> Piece:
    """Add up pieces of one tile voxel by voxel; rows come out ordered by voxel."""
    voxel = np.concatenate([piece.voxel for piece in pieces])
    order = np.argsort(voxel, kind="stable")  # timsort: the pieces come sorted, so this is a merge
    starts = np.flatnonzero(np.diff(voxel[order], prepend=-1))
    if len(pieces) == 1 and len(starts) == len(order):
        return pieces[0].take(order)

    def total(column: str) -> NDArray:
        """One column at a time: a dense tile is large."""
        return _sum_runs(np.concatenate([getattr(piece, column) for piece in pieces]), order, starts)

    sums: dict[str, Any] = {name: total(name) for name in columns_of(Piece) if name != "voxel"}
    return Piece(voxel=voxel[order[starts]], **sums, **pieces[0].attributes)


@kernel
def _sum_runs(values: NDArray, order: NDArray[np.int64], starts: NDArray[np.int64]) -> NDArray:
    """Sum of the values in this order over each run from one start to the next."""
    out = np.zeros(len(starts), values.dtype)
    for run in range(len(starts)):
        end = starts[run + 1] if run + 1 < len(starts) else len(order)
        for i in range(starts[run], end):
            out[run] += values[order[i]]
    return out


def _identity(pieces: Parts[Piece]) -> tuple[str, tuple[str, ...]]:
    """Name of the tile and the sessions that contribute."""
    coordinates = pieces.coordinates()
    names = {coordinate["tile"] for coordinate in coordinates}
    if len(names) != 1:
        raise StageError(
            f"expected the pieces of one tile, got those of {len(names)}",
            next_step="run tiling first; a tile is made of the pieces it wrote",
        )
    return names.pop(), tuple(sorted({c["session"] for c in coordinates if "session" in c}))


def _scenery(sums: Piece) -> NDArray[np.uint8]:
    ground = 2 * sums.ground_count > sums.count
    return np.where(ground, PointClass.GROUND, PointClass.STATIC).astype(np.uint8)


def _left_out(sums: Piece) -> NDArray[np.uint8]:
    classes: NDArray[np.uint8] = np.array([0, *LEFT_OUT], np.uint8)[sums.voxel >> RANK_SHIFT]
    return classes


def _average(sums: Piece, name: str, sessions: tuple[str, ...]) -> dict[str, Any]:
    """Columns and attributes of a tile but for the class."""
    x, y = tile_position(name)
    count = np.maximum(sums.count, 1)
    return {
        "x_m": (sums.sum_x_m / count).astype(np.float32),
        "y_m": (sums.sum_y_m / count).astype(np.float32),
        "z_m": (sums.sum_z_m / count).astype(np.float32),
        "intensity": (sums.sum_intensity / count).astype(np.float32),
        "count": sums.count,
        "offset_m": (x * sums.tile_size_m, y * sums.tile_size_m, 0.0),
        "frame": sums.frame,
        "georeference": sums.georeference,
        "voxel_size_m": sums.voxel_size_m,
        "tile_size_m": sums.tile_size_m,
        "sessions": sessions,
    }


def tile_ply(tile: Tile) -> bytes:
    """The tile as PLY: coordinates from the tile's origin, the origin and the CRS in the comments."""
    comments = ["scanloom tile", *ply.georeference_comments(tile.frame, tile.georeference, tile.offset_m)]
    points = np.column_stack((tile.x_m, tile.y_m, tile.z_m))
    return ply.header(len(tile), comments) + ply.vertices(points, tile.intensity, tile.class_)
