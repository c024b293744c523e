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
    SCHEMA_VERSION: ClassVar[int] = 3
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
    frame: str = attribute("`world` or `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")
    voxel_size_m: float = attribute("edge of a voxel, m")
    tile_size_m: float = attribute("edge of a tile, m")


@dataclass(frozen=True)
class Tile(Table):
    """Points of one tile, voxel-filtered, from the tile's own origin. One part per tile."""

    NAME: ClassVar[str] = "tile"
    SPLIT_BY: ClassVar[str] = "tile"

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
    offset_m: tuple[float, ...] = attribute("add to the coordinates to get the map's frame, doubles, m")
    frame: str = attribute("`world` or `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")
    voxel_size_m: float = attribute("edge of a voxel, m")
    tile_size_m: float = attribute("edge of a tile, m")
    sessions: tuple[str, ...] = attribute("sessions that contributed")


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
    """One row per tile of the map."""

    NAME: ClassVar[str] = "tile_index"

    tile: NDArray[np.object_] = column("str", "name of the tile, `X_Y` in steps of the tile size")
    level: NDArray[np.int32] = column("i4", "0 is the full resolution")
    points: NDArray[np.int64] = column("i8", "points in the tile")
    min_m: NDArray[np.float64] = column(
        "f8", "lowest corner of the points", unit="m", shape=(3,), frame="world or map"
    )
    max_m: NDArray[np.float64] = column(
        "f8", "highest corner of the points", unit="m", shape=(3,), frame="world or map"
    )
    sessions: NDArray[np.object_] = column("str", "sessions that contributed, separated by spaces")
    checksum: NDArray[np.object_] = column("str", "SHA-256 of the tile's columns")
    frame: str = attribute("`world` or `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")
    tile_size_m: float = attribute("edge of a tile, m")
    voxel_size_m: float = attribute("edge of a voxel, m")


@dataclass(frozen=True)
class MapFiles(Files):
    """The whole map as one cloud, local coordinates, offset and CRS in its comments.

    `map.ply`, and `removed.ply` with what was left out of it, each point with its class.
    """

    NAME: ClassVar[str] = "map_files"
