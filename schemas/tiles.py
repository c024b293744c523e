"""The map itself: pieces on their way, tiles, the list of tiles, the overview cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Files, Table, attribute, column
from scanloom.schemas.scans import PointClass

LEFT_OUT = (PointClass.DYNAMIC, PointClass.AIRBORNE, PointClass.OUTLIER, PointClass.CHANGED)
"""Classes of points that are left out of the map and kept beside it, in the order of their rows."""
RANK_SHIFT = 39
"""In a piece's `voxel` a 0 above this bit stands for points of the map, n for those of `LEFT_OUT[n - 1]`."""


@dataclass(frozen=True)
class Piece(Table):
    """What one chunk adds to one tile: sums per voxel, to be merged. One part per tile, keyed `X_Y`."""

    NAME: ClassVar[str] = "piece"
    SCHEMA_VERSION: ClassVar[int] = 4
    ON_THE_WAY: ClassVar[bool] = True
    SPLIT_BY: ClassVar[str] = "tile"

    voxel: NDArray[np.int64] = column(
        "i8",
        "voxel from the tile's corner, x 2^29 + y 2^19 + z + 2^18, plus 2^39 for each step in `LEFT_OUT`; rows are "
        "ordered by it",
    )
    count: NDArray[np.int32] = column("i4", "points summed")
    sum_x_m: NDArray[np.float64] = column("f8", "sum of x from the tile's corner", unit="m")
    sum_y_m: NDArray[np.float64] = column("f8", "sum of y from the tile's corner", unit="m")
    sum_z_m: NDArray[np.float64] = column("f8", "sum of z", unit="m")
    sum_intensity: NDArray[np.float64] = column("f8", "sum of intensities")
    ground_count: NDArray[np.int32] = column("i4", "points of class ground among them")
    scan_count: NDArray[np.int32] = column("i4", "scans that hit the voxel")
    first_ns: NDArray[np.int64] = column("i8", "reference time of the first of them", unit="ns")
    last_ns: NDArray[np.int64] = column("i8", "reference time of the last of them", unit="ns")
    view: NDArray[np.int8] = column(
        "i1",
        "direction to the LiDAR of the first scan, unit vector times 127",
        shape=(3,),
        frame="world or map",
    )
    frame: str = attribute("`world` or `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")
    voxel_size_m: float = attribute("edge of a voxel, m")
    tile_size_m: float = attribute("edge of a tile, m")


@dataclass(frozen=True)
class Paint(Table):
    """What the images of one stretch add to the colour of one tile, in a brightness of its own. One part per tile; rows are
    ordered by `voxel`.

    Sums are whole numbers, so that they do not depend on the order in which they are added.
    """

    NAME: ClassVar[str] = "paint"
    ON_THE_WAY: ClassVar[bool] = True
    SPLIT_BY: ClassVar[str] = "tile"
    WEIGHT_STEPS: ClassVar[int] = 1 << 16
    LIGHT_STEPS: ClassVar[int] = 1 << 24

    voxel: NDArray[np.int64] = column("i8", "voxel, as in `piece`; of points of the map only")
    weight: NDArray[np.int64] = column("i8", "sum of the weights of the views, in steps of 2^-16")
    light: NDArray[np.int64] = column(
        "i8", "sum of weight times linear red, green, blue, in steps of 2^-24", shape=(3,)
    )
    views: NDArray[np.int32] = column("i4", "images that saw the voxel")


@dataclass(frozen=True)
class Colours(Paint):
    """The colours that all images of a session give one tile, in one brightness. One part per tile; rows are ordered by `voxel`."""

    NAME: ClassVar[str] = "colours"


@dataclass(frozen=True)
class Tile(Table):
    """Points of one tile, voxel-filtered, from the tile's own origin. One part per tile.

    The points of a level and of all above are the map thinned to the spacing of that level (see `spacing_m`), none twice.
    Rows are ordered by level, coarsest first, then by the Morton code of the place: an octant of the tile is a
    run of rows of a level. In the file the levels from `ALONE` down are row groups of their own, so that a viewer reads no more than it shows.
    """

    NAME: ClassVar[str] = "tile"
    SCHEMA_VERSION: ClassVar[int] = 3
    SPLIT_BY: ClassVar[str | None] = "tile"
    ALONE: ClassVar[int] = 3

    x_m: NDArray[np.float32] = column(
        "f4", "from the tile's origin, along x of the map", unit="m", frame="tile"
    )
    y_m: NDArray[np.float32] = column(
        "f4", "from the tile's origin, along y of the map", unit="m", frame="tile"
    )
    z_m: NDArray[np.float32] = column("f4", "from the tile's origin, up", unit="m", frame="tile")
    intensity: NDArray[np.float32] = column("f4", "mean intensity of the voxel's points")
    class_: NDArray[np.uint8] = column(
        "u1", "a value of PointClass: ground or static; else in a removed tile"
    )
    count: NDArray[np.int32] = column("i4", "points averaged")
    level: NDArray[np.uint8] = column("u1", "0 is what only the full resolution has")
    first_ns: NDArray[np.int64] = column("i8", "when the voxel was first met", unit="ns")
    last_ns: NDArray[np.int64] = column("i8", "when it was last met", unit="ns")
    session: NDArray[np.uint16] = column("u2", "number in `sessions` of the session that met it first")
    normal: NDArray[np.int8] = column(
        "i1",
        "unit normal of the surface times 127, towards the LiDAR that met it first; zeros where there is no surface",
        shape=(3,),
        frame="world or map",
    )
    colour: NDArray[np.uint8] = column(
        "u1", "red, green, blue (sRGB) from images; zeros where none saw it", shape=(3,)
    )
    views: NDArray[np.uint16] = column("u2", "images that the colour is from; 0 where none saw it")
    offset_m: tuple[float, ...] = attribute("add to the coordinates to get the map's frame, doubles, m")
    frame: str = attribute("`world` or `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")
    voxel_size_m: float = attribute("edge of a voxel, m")
    tile_size_m: float = attribute("edge of a tile, m")
    sessions: tuple[str, ...] = attribute("sessions that contributed")

    def row_groups(self) -> tuple[int, ...]:
        """Rows of each row group: the coarse levels together, then level after level."""
        coarse = int(np.count_nonzero(self.level > self.ALONE))
        finer = [int(np.count_nonzero(self.level == level)) for level in range(self.ALONE, -1, -1)]
        return tuple(rows for rows in (coarse, *finer) if rows) or (0,)


def levels_of(tile_size_m: float, voxel_size_m: float) -> int:
    """The coarsest level: one point for the whole tile."""
    return max(int(np.ceil(np.log2(tile_size_m / voxel_size_m) - 1e-9)), 0)


def spacing_m(level: int, tile_size_m: float, voxel_size_m: float) -> float:
    """Edge of the cells that hold one point each of a level and those above; the voxel's own for level 0."""
    return tile_size_m / 2.0 ** (levels_of(tile_size_m, voxel_size_m) - level) if level else voxel_size_m


@dataclass(frozen=True)
class RemovedTile(Tile):
    """Points of one tile that are left out of the map, as a tile: one point per voxel and class. One part per tile."""

    NAME: ClassVar[str] = "removed_tile"


@dataclass(frozen=True)
class TileFiles(Files):
    """The same tile in a format of the outside world: `X_Y.ply`. One part per tile."""

    NAME: ClassVar[str] = "tile_files"
    SPLIT_BY: ClassVar[str] = "tile"


@dataclass(frozen=True)
class TileIndex(Table):
    """One row per tile of the map and level, coarsest level first."""

    NAME: ClassVar[str] = "tile_index"
    SCHEMA_VERSION: ClassVar[int] = 2

    tile: NDArray[np.object_] = column("str", "name of the tile, `X_Y` in steps of the tile size")
    level: NDArray[np.int32] = column("i4", "0 is what only the full resolution has")
    points: NDArray[np.int64] = column("i8", "points of the level in the tile")
    first_row: NDArray[np.int64] = column("i8", "row of the first of them in the tile")
    min_m: NDArray[np.float64] = column(
        "f8", "lowest corner of the points", unit="m", shape=(3,), frame="world or map"
    )
    max_m: NDArray[np.float64] = column(
        "f8", "highest corner of the points", unit="m", shape=(3,), frame="world or map"
    )
    sessions: NDArray[np.object_] = column(
        "str", "sessions that contributed to the tile, separated by spaces"
    )
    checksum: NDArray[np.object_] = column("str", "SHA-256 of the level's rows, column by column")
    frame: str = attribute("`world` or `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")
    tile_size_m: float = attribute("edge of a tile, m")
    voxel_size_m: float = attribute("edge of a voxel, m")

    @property
    def names(self) -> list[str]:
        """The tiles, each once, in order."""
        return list(dict.fromkeys(str(name) for name in self.tile))

    @property
    def filled(self) -> TileIndex:
        """Rows that have points; a tile without any stays on the list."""
        return self.take(self.points > 0)

    @property
    def bounds_m(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 3) of all points, m; zeros where there is none."""
        filled = self.filled
        if not len(filled):
            return np.zeros((2, 3))
        return np.stack((filled.min_m.min(axis=0), filled.max_m.max(axis=0)))

    def by_tile(self) -> dict[str, slice]:
        """Rows of each tile."""
        starts = [i for i in range(len(self)) if i == 0 or self.tile[i] != self.tile[i - 1]]
        return {str(self.tile[a]): slice(a, b) for a, b in zip(starts, [*starts[1:], len(self)])}


@dataclass(frozen=True)
class Overview(Tile):
    """The coarsest levels of all tiles, as many as fit: what a viewer shows of the whole map at first.

    Rows are ordered by level, coarsest first, then by tile. Coordinates are from the origin of each point's own tile.
    """

    NAME: ClassVar[str] = "overview_cloud"
    SCHEMA_VERSION: ClassVar[int] = 2
    SPLIT_BY: ClassVar[str | None] = None

    tile: NDArray[np.int32] = column("i4", "number of the tile in the order of the index")

    def row_groups(self) -> tuple[int, ...]:
        """One row group per level."""
        return tuple(int(rows) for rows in np.bincount(self.level)[::-1] if rows) or (0,)


@dataclass(frozen=True)
class MapFiles(Files):
    """The whole map as one cloud, local coordinates, offset and CRS in its comments.

    `map.ply`, and `removed.ply` with what was left out of it, each point with its class.
    """

    NAME: ClassVar[str] = "map_files"
