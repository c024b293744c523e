"""Tiles: pieces of all chunks and sessions merged into the voxel-filtered points of one tile."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts, column, columns_of
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT, RANK_SHIFT, Colours, Piece, RemovedTile, Tile, TileFiles
from scanloom.stages.geometry import ply
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.normals import normals
from scanloom.stages.tiling.colours import coloured
from scanloom.stages.tiling.grid import tile_position
from scanloom.stages.tiling.levels import ordered
from scanloom.stages.tiling.voxel_sums import STEP_X, STEP_Y

VERSION = 3

I8 = NDArray[np.int64]

ROWS_AT_ONCE = 150_000
"""Voxels that wait to be merged."""


class Settings(BaseModel):
    """Which voxels become points of the map."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_points: int = Field(1, ge=1, le=1000, description="points a voxel needs to enter the map")
    min_scans: int = Field(
        1, ge=1, le=1000, description="different scans of one chunk or more that must hit a voxel"
    )


@dataclass(frozen=True)
class Met(Piece):
    """A piece of several sessions."""

    NAME: ClassVar[str] = "met"

    session: NDArray[np.uint16] = column("u2", "number of the session that met the voxel first")


def tiles(
    settings: Settings, pieces: Parts[Piece], colours: Parts[Colours] | None = None
) -> tuple[Tile, RemovedTile, TileFiles]:
    """Merge the pieces of one tile: the mean point, mean intensity and majority class of every voxel, its normal, when
    and by whom it was met; then order the points by level of detail.

    Points that images saw get the mean of their views as colour. What is left out of the map is averaged likewise, class by class, and has no colour. The sums are exact (see `voxel_sums`), hence the tile
    does not depend on the order of the pieces.

    Raises
    ------
    StageError : there are no pieces, or they belong to different grids or tiles.
    """
    name, sessions = _identity(pieces)
    merged = merge_all(name, _by_session(pieces, sessions))
    first_out = int(np.searchsorted(merged.voxel, 1 << RANK_SHIFT))
    of_map, left_out = merged.take(slice(0, first_out)), merged.take(slice(first_out, None))
    kept = of_map.take((of_map.count >= settings.min_points) & (of_map.scan_count >= settings.min_scans))
    colour = coloured(kept.voxel, colours or ())
    tile = _ordered(Tile(**_average(kept, name, sessions), **colour, class_=_scenery(kept)))
    removed = _ordered(
        RemovedTile(
            **_average(left_out, name, sessions), **coloured(left_out.voxel, ()), class_=_left_out(left_out)
        )
    )
    return tile, removed, TileFiles(contents={"tile.ply": tile_ply(tile)})


TileT = TypeVar("TileT", bound=Tile)


def _ordered(tile: TileT) -> TileT:
    """By level, coarsest first, and place."""
    order, level = ordered(tile.x_m, tile.y_m, tile.z_m, tile.tile_size_m, tile.voxel_size_m)
    return replace(tile.take(order), level=level)


def _by_session(pieces: Parts[Piece], sessions: tuple[str, ...]) -> Iterator[Met]:
    number = {name: i for i, name in enumerate(sessions)}
    for where, piece in pieces.items():
        session = np.full(len(piece), number.get(where.get("session", ""), 0), np.uint16)
        columns = {name: getattr(piece, name) for name in columns_of(Piece)}
        yield Met(**columns, **piece.attributes, session=session)


def merge_all(name: str, pieces: Iterable[Met]) -> Met:
    """Merge piece after piece, so that a place passed a hundred times takes no more memory than one passed twice.

    Raises
    ------
    StageError : the pieces were made with different grids or georeferences.
    """
    waiting: list[Met] = []
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


OF_THE_FIRST = ("session", "view")
"""Columns that are those of the earliest piece."""


def merge(pieces: list[Met]) -> Met:
    """Add up pieces of one tile voxel by voxel; rows come out ordered by voxel."""
    voxel = np.concatenate([piece.voxel for piece in pieces])
    order = np.argsort(voxel, kind="stable")  # timsort: the pieces come sorted, so this is a merge
    starts = np.flatnonzero(np.diff(voxel[order], prepend=-1))
    if len(pieces) == 1 and len(starts) == len(order):
        return pieces[0].take(order)

    def joined(column: str) -> NDArray:
        """One column at a time: a dense tile is large."""
        return np.concatenate([getattr(piece, column) for piece in pieces])

    first_ns = joined("first_ns")
    earliest = _earliest(first_ns, joined("session"), joined("view"), order, starts)
    columns: dict[str, Any] = {"voxel": voxel[order[starts]], "first_ns": first_ns[earliest]}
    columns["last_ns"] = _latest(joined("last_ns"), order, starts)
    columns |= {name: joined(name)[earliest] for name in OF_THE_FIRST}
    sums = [name for name in columns_of(Met) if name not in columns]
    columns |= {name: _sum_runs(joined(name), order, starts) for name in sums}
    return Met(**columns, **pieces[0].attributes)


@kernel
def _earliest(first_ns: I8, session: NDArray[np.uint16], view: NDArray[np.int8], order: I8, starts: I8) -> I8:
    """The row of each run that was met first; equal stamps are told apart so that the order of pieces does not matter."""
    out = np.empty(len(starts), np.int64)
    for run in range(len(starts)):
        end = starts[run + 1] if run + 1 < len(starts) else len(order)
        best = order[starts[run]]
        for i in range(starts[run] + 1, end):
            n = order[i]
            a = (
                first_ns[n],
                np.int64(session[n]),
                np.int64(view[n, 0]),
                np.int64(view[n, 1]),
                np.int64(view[n, 2]),
            )
            b = (
                first_ns[best], np.int64(session[best]), np.int64(view[best, 0]), np.int64(view[best, 1]),
                np.int64(view[best, 2]),
            )  # fmt: skip
            if a < b:
                best = n
        out[run] = best
    return out


@kernel
def _latest(last_ns: I8, order: I8, starts: I8) -> I8:
    out = np.empty(len(starts), np.int64)
    for run in range(len(starts)):
        end = starts[run + 1] if run + 1 < len(starts) else len(order)
        out[run] = last_ns[order[starts[run]]]
        for i in range(starts[run] + 1, end):
            out[run] = max(out[run], last_ns[order[i]])
    return out


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


def _average(sums: Met, name: str, sessions: tuple[str, ...]) -> dict[str, Any]:
    """Columns and attributes of a tile but for the class; all of the full resolution so far."""
    x, y = tile_position(name)
    count = np.maximum(sums.count, 1)
    x_m, y_m, z_m = (total / count for total in (sums.sum_x_m, sums.sum_y_m, sums.sum_z_m))
    return {
        "x_m": x_m.astype(np.float32),
        "y_m": y_m.astype(np.float32),
        "z_m": z_m.astype(np.float32),
        "intensity": (sums.sum_intensity / count).astype(np.float32),
        "count": sums.count,
        "level": np.zeros(len(sums), np.uint8),
        "first_ns": sums.first_ns,
        "last_ns": sums.last_ns,
        "session": sums.session,
        "normal": normals(sums.voxel, x_m, y_m, z_m, sums.view, STEP_X, STEP_Y, 0.5 * sums.tile_size_m),
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
    colour = tile.colour if tile.views.any() else None
    vertex = ply.VERTEX if colour is None else ply.COLOURED
    return ply.header(len(tile), comments, vertex) + ply.vertices(points, tile.intensity, tile.class_, colour)
