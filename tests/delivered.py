"""The folder of a delivered map from bare points: what exports and the viewer start from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.product import columns_of
from scanloom.schemas.tiles import Overview, Tile, TileIndex
from tests.tiles import tile_of


def cut(
    points: np.ndarray,
    *,
    tile_size_m: float = 50.0,
    columns: dict[str, np.ndarray] | None = None,
    **more: Any,
) -> dict[str, Tile]:
    """Tiles of points (n, 3) in the frame of the map, by name in the order of the index."""
    place = np.floor(np.asarray(points)[:, :2] / tile_size_m).astype(int)
    out = {}
    for x, y in sorted({(int(x), int(y)) for x, y in place}):
        rows = (place == (x, y)).all(axis=1)
        offset = (x * tile_size_m, y * tile_size_m, 0.0)
        picked = {name: column[rows] for name, column in (columns or {}).items()}
        out[f"{x}_{y}"] = tile_of(
            points[rows] - np.array(offset), offset_m=offset, tile_size_m=tile_size_m, **more, **picked
        )
    return out


def index_of(tiles: dict[str, Tile]) -> TileIndex:
    """One row per tile and level, coarsest first."""
    rows = []
    for name, tile in tiles.items():
        for level in range(int(tile.level.max(initial=0)), -1, -1):
            here = np.flatnonzero(tile.level == level)
            if len(here):
                part = tile.take(here)
                xyz = np.column_stack((part.x_m, part.y_m, part.z_m)) + np.array(tile.offset_m)
                sessions = " ".join(tile.sessions)
                rows.append((name, level, len(here), here[0], xyz.min(axis=0), xyz.max(axis=0), sessions, ""))
    names, levels, points, first, low, high, sessions_, checksums = zip(*rows)
    example = next(iter(tiles.values()))
    return TileIndex(
        tile=np.array(names, object), level=np.array(levels, np.int32), points=np.array(points, np.int64),
        first_row=np.array(first, np.int64), min_m=np.array(low), max_m=np.array(high), sessions=np.array(sessions_, object),
        checksum=np.array(checksums, object), frame=example.frame, georeference=example.georeference,
        tile_size_m=example.tile_size_m, voxel_size_m=example.voxel_size_m,
    )  # fmt: skip


def overview_of(tiles: dict[str, Tile], most: int) -> Overview:
    """The coarsest levels of all tiles that together hold at most so many points."""
    counts = np.sum([np.bincount(t.level, minlength=30) for t in tiles.values()], axis=0)
    down_to = np.cumsum(counts[::-1])[::-1]
    lowest = int(np.argmax(down_to <= most))
    numbered = [(i, tile.take(tile.level >= lowest)) for i, tile in enumerate(tiles.values())]
    columns = {
        name: np.concatenate([getattr(tile, name) for _, tile in numbered]) for name in columns_of(Tile)
    }
    number = np.repeat(
        np.array([i for i, _ in numbered], np.int32), [len(tile) for _, tile in numbered]
    ).astype(np.int32)
    order = np.lexsort((np.arange(len(number)), number, -columns["level"].astype(int)))
    example = next(iter(tiles.values()))
    picked = {name: column[order] for name, column in columns.items()}
    return Overview(**picked, tile=number[order], **example.attributes)


def write_map(
    folder: Path, tiles: dict[str, Tile], *, overview_points: int = 4_000_000, **header: Any
) -> TileIndex:
    """Write what a reader of maps needs."""
    (folder / "tiles").mkdir(parents=True)
    for name, tile in tiles.items():
        tile.write(folder / "tiles" / f"{name}.parquet")
    index = index_of(tiles)
    index.write(folder / "tiles" / "index.parquet")
    overview_of(tiles, overview_points).write(folder / "tiles" / "overview.parquet")
    sessions = sorted({name for tile in tiles.values() for name in tile.sessions})
    body: dict[str, Any] = {
        "format": "scanloom map 1", "name": folder.name, "version": 1, "frame": index.frame, "crs": index.georeference,
        "epsg": index.georeference["epsg"] if index.georeference else None, "origin": index.georeference,
        "bounds_m": {"min": index.min_m.min(axis=0).tolist(), "max": index.max_m.max(axis=0).tolist()},
        "points": int(index.points.sum()), "tile_size_m": index.tile_size_m, "voxel_size_m": index.voxel_size_m,
        "sessions": [{"name": name} for name in sessions], "files": {},
    }  # fmt: skip
    (folder / "map.json").write_text(json.dumps(body | header))
    return index
