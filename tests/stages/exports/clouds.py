"""Small maps with every column filled, and what must come out of an export of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import RemovedTile
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import georeference
from tests.delivered import cut, write_map
from tests.tiles import tile_of

MUNICH = georeference(48.137, 11.5753, 560.0)
PUNTA_ARENAS = georeference(-53.16, -70.91, 12.0)
FIRST_NS = 1_700_000_000_123_456_789


def scattered(
    seed: int, n: int = 4000, reach_m: float = 90.0, far_m: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Points (n, 3) over several tiles on both sides of the origin, or around a place far away."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-reach_m, reach_m, (n, 2)) + far_m
    return np.column_stack((flat, rng.uniform(-8.0, 25.0, n)))


def columns(seed: int, n: int) -> dict[str, np.ndarray]:
    """A value of its own in every column of every point."""
    rng = np.random.default_rng(seed + 1)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = FIRST_NS + rng.integers(0, 10**11, n)
    return {
        "intensity": rng.uniform(0.0, 200.0, n).astype(np.float32),
        "class_": rng.choice([PointClass.GROUND, PointClass.STATIC], n).astype(np.uint8),
        "count": rng.integers(1, 5000, n).astype(np.int32),
        "first_ns": first,
        "last_ns": first + rng.integers(0, 10**10, n),
        "session": rng.integers(0, 2, n).astype(np.uint16),
        "normal": np.rint(127.0 * normal).astype(np.int8),
    }


def write(folder: Path, points: np.ndarray, origin: Any = MUNICH, seed: int = 0, **more: Any) -> MapSource:
    """A map of two sessions, delivered."""
    fields = None if origin is None else origin.model_dump()
    filled = columns(seed, len(points)) | more
    tiles = cut(points, georeference=fields, sessions=("b", "a"), columns=filled)
    write_map(folder, tiles)
    return MapSource.open(folder)


def add_removed(folder: Path, points: np.ndarray, origin: Any = MUNICH) -> None:
    """Points left out of the tile 0_0: a car that drove away, dust, and noise, in turn."""
    kinds = np.resize([PointClass.DYNAMIC, PointClass.AIRBORNE, PointClass.OUTLIER], len(points))
    fields = None if origin is None else origin.model_dump()
    tile = tile_of(
        points, kind=RemovedTile, georeference=fields, sessions=("a",), **columns(7, len(points)) | {
            "class_": kinds.astype(np.uint8), "session": np.zeros(len(points), np.uint16)
        },
    )  # fmt: skip
    (folder / "removed").mkdir(exist_ok=True)
    tile.write(folder / "removed" / "0_0.parquet")


def expected(source: MapSource, projector: Projector) -> np.ndarray:
    """Coordinates (n, 3) of all points in the order of the tiles, every one by PROJ."""
    parts = [
        projector.project(
            np.column_stack((tile.x_m, tile.y_m, tile.z_m)).astype(float) + np.array(tile.offset_m)
        )
        for _, tile in source.tiles()
    ]
    return np.concatenate(parts)


def column(source: MapSource, name: str) -> np.ndarray:
    """A column of all points in the order of the tiles."""
    return np.concatenate([getattr(tile, name) for _, tile in source.tiles()])


def sorted_rows(rows: np.ndarray) -> np.ndarray:
    return rows[np.lexsort(rows.T)]


def colours(seed: int, n: int) -> dict[str, np.ndarray]:
    """What cameras saw: every third point not at all."""
    rng = np.random.default_rng(seed + 2)
    seen = np.arange(n) % 3 > 0
    colour = np.where(seen[:, None], rng.integers(1, 256, (n, 3)), 0).astype(np.uint8)
    return {"colour": colour, "views": np.where(seen, rng.integers(1, 60000, n), 0).astype(np.uint16)}
