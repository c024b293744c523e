"""Tiles from bare points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import Tile
from scanloom.stages.tiling.levels import ordered

TileT = TypeVar("TileT", bound=Tile)


def tile_of(
    points: np.ndarray, *, kind: type[TileT] = Tile, class_: int = int(PointClass.STATIC),  # type: ignore[assignment]
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0), georeference: dict[str, Any] | None = None,
    voxel_size_m: float = 0.1, tile_size_m: float = 50.0, sessions: tuple[str, ...] = ("a",), **columns: np.ndarray,
) -> TileT:  # fmt: skip
    """A tile of points (n, 3) from its origin, ordered as tiles are; `columns` replace the usual ones, row by row."""
    n = len(points)
    x, y, z = (np.ascontiguousarray(c) for c in np.asarray(points, np.float32).reshape(-1, 3).T)
    usual: dict[str, np.ndarray] = {
        "intensity": np.zeros(n, np.float32), "class_": np.full(n, class_, np.uint8), "count": np.ones(n, np.int32),
        "level": np.zeros(n, np.uint8), "first_ns": np.zeros(n, np.int64), "last_ns": np.zeros(n, np.int64),
        "session": np.zeros(n, np.uint16), "normal": np.zeros((n, 3), np.int8),
        "colour": np.zeros((n, 3), np.uint8), "views": np.zeros(n, np.uint16),
    }  # fmt: skip
    tile = kind(
        x_m=x, y_m=y, z_m=z, **(usual | columns), offset_m=offset_m, frame="world" if georeference else "map",
        georeference=georeference, voxel_size_m=voxel_size_m, tile_size_m=tile_size_m, sessions=sessions,
    )  # fmt: skip
    order, level = ordered(tile.x_m, tile.y_m, tile.z_m, tile_size_m, voxel_size_m)
    return replace(tile.take(order), level=level)
