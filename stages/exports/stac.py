"""The map as an item of a SpatioTemporal Asset Catalog (STAC 1.1): where, when, in which system, and every file of it."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.frames import Georeference
from scanloom.schemas.product import columns_of
from scanloom.schemas.tiles import Tile
from scanloom.stages.exports.antimeridian import area_geometry, bounding_box
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.wgs84 import moment, origin_of
from scanloom.stages.geometry.geodesy import world_to_geodetic
from scanloom.stages.geometry.se3 import F8

ITEM = "item.json"
EXTENSIONS = {
    "pointcloud": "https://stac-extensions.github.io/pointcloud/v1.0.0/schema.json",
    "projection": "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "file": "https://stac-extensions.github.io/file/v2.1.0/schema.json",
}
SHA256_MULTIHASH = "1220"
"""Code of SHA-256 and its length in bytes, which a multihash begins with."""
TYPE_WORDS = {"f": "floating", "u": "unsigned", "i": "signed", "b": "unsigned"}
MEDIA_TYPES = {
    ".copc.laz": "application/vnd.laszip+copc",
    ".laz": "application/vnd.laszip",
    ".las": "application/vnd.las",
    ".tif": "image/tiff; application=geotiff; profile=cloud-optimized",
    ".parquet": "application/vnd.apache.parquet",
    ".geojson": "application/geo+json",
    ".gpx": "application/gpx+xml",
    ".json": "application/json",
    ".glb": "model/gltf-binary",
    ".html": "text/html",
    ".png": "image/png",
    ".yaml": "application/yaml",
    ".txt": "text/plain",
    ".tum": "text/plain",
}
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
UNKNOWN = "application/octet-stream"
DELIVERED = {
    "map.ply": ("The whole map as one cloud, local coordinates", ["data"]),
    "tiles/index.parquet": ("Tiles and levels of the map, with bounds and checksums", ["index"]),
    "trajectory.parquet": ("Poses of the LiDAR", ["trajectory"]),
    "metrics.json": ("How good the map is, in figures", ["metadata"]),
    "report.html": ("How far to trust the map", ["overview"]),
    "preview.png": ("Picture of the map", ["thumbnail"]),
}


def write_stac(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`item.json`: the map's footprint, its times, its point cloud, and an asset for every file of the other exports.

    The exports are those that lie beside `folder` when this one is written.

    Raises
    ------
    InvalidInput : the map has no georeference, no points or no trajectory.
    UsageError : the system asked for is not known, or its grid is not installed.
    """
    import pystac

    origin = origin_of(source, "stac")
    projector = Projector.of(source, options)
    start, end = (moment(stamp) for stamp in _times(source))
    ring = footprint(source, origin)
    heights = world_to_geodetic(origin, _corners(source))[:, 2]
    (west, south, east, north), low, high = bounding_box(ring), heights.min(), heights.max()
    item = pystac.Item(
        id=source.name,
        geometry=area_geometry(ring),
        bbox=[west, south, float(low), east, north, float(high)],
        datetime=start,
        start_datetime=start,
        end_datetime=end,
        properties=_properties(source, projector),
        stac_extensions=list(EXTENSIONS.values()),
    )
    for key, asset in _assets(source.folder, folder):
        item.add_asset(key, asset)
    path = folder / ITEM
    content = item.to_dict(include_self_link=False)
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return [path]


def footprint(source: MapSource, origin: Georeference) -> F8:
    """Corners (n, 2) of the convex area around all tiles' points, longitude and latitude, counter-clockwise."""
    corners = _corners(source)
    hull = convex_hull(corners[:, :2])
    if len(hull) < 3:
        edge = source.index.voxel_size_m / 2.0
        hull = convex_hull(np.concatenate([hull + np.array(step) for step in SQUARE * edge]))
    flat = np.column_stack((hull, np.full(len(hull), corners[:, 2].mean())))
    latitude, longitude, _ = world_to_geodetic(origin, flat).T
    return np.column_stack((longitude, latitude))


def convex_hull(points: F8) -> F8:
    """Corners of the convex hull of points (n, 2), counter-clockwise (monotone chain, Andrew 1979)."""
    ordered = sorted({(float(x), float(y)) for x, y in points})
    if len(ordered) < 3:
        return np.array(ordered)

    def chain(way: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for p in way:
            while len(kept) > 1 and _turn(kept[-2], kept[-1], p) <= 0.0:
                kept.pop()
            kept.append(p)
        return kept[:-1]

    return np.array(chain(ordered) + chain(reversed(ordered)))


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Positive when a, b, c turn left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _corners(source: MapSource) -> F8:
    """The eight corners of every tile's bounds, (8 n, 3), in the map's frame."""
    some = source.index.points > 0
    low, high = source.index.min_m[some], source.index.max_m[some]
    picks = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    return np.concatenate([np.where(pick, high, low) for pick in picks])


def _times(source: MapSource) -> tuple[int, int]:
    """First and last stamp of all poses, ns."""
    if not source.points:
        raise InvalidInput(
            "holds no points, so that it lies nowhere",
            where=str(source.folder),
            next_step="leave stac out of --format",
        )
    stamps = [p.stamp_ns for p in source.trajectories().values() if len(p)]
    if not stamps:
        raise InvalidInput(
            "has no trajectory, so that nobody knows when it was measured",
            where=str(source.folder),
            next_step="leave stac out of --format",
        )
    return min(int(s.min()) for s in stamps), max(int(s.max()) for s in stamps)


def _properties(source: MapSource, projector: Projector) -> dict[str, Any]:
    corners, crs = projector.project(_corners(source)), projector.plain_crs
    return {
        "title": source.name,
        "proj:code": f"EPSG:{crs.to_epsg()}" if crs.to_epsg() else None,
        "proj:projjson": crs.to_json_dict(),
        "proj:bbox": [*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()],
        "pc:count": source.points,
        "pc:type": "lidar",
        "pc:encoding": "Parquet",
        "pc:schemas": point_schema(),
        "scanloom:heights": projector.heights,
        "scanloom:sessions": sorted(source.trajectories()),
        "scanloom:voxel_size_m": float(source.index.voxel_size_m),
    }


def point_schema() -> list[dict[str, Any]]:
    """What the map knows of a point: the columns of its tiles; x, y, z from the tile's origin."""
    rows = []
    for name, column in columns_of(Tile).items():
        kind = np.dtype(column.dtype)
        parts = [f"_{axis}" for axis in "xyz"] if column.shape else [""]
        word = TYPE_WORDS[kind.kind]
        rows += [{"name": name.strip("_") + part, "size": kind.itemsize, "type": word} for part in parts]
    return rows


def _assets(map_folder: Path, item_folder: Path) -> Iterator[tuple[str, Any]]:
    """Key and asset of each delivered and each exported file, in order."""
    for delivered, (title, roles) in DELIVERED.items():
        if (map_folder / delivered).is_file():
            yield delivered, _asset(map_folder / delivered, item_folder, title, roles)
    for path in exported_files(item_folder.parent):
        name = path.relative_to(item_folder.parent)
        role = "metadata" if path.suffix in {".txt", ".yaml"} else "data"
        yield (
            f"exports/{name.as_posix()}",
            _asset(path, item_folder, f"{name.parts[0]}: {name.name}", [role]),
        )


def exported_files(exports: Path) -> list[Path]:
    """Files of all finished exports in a folder but the catalogue's own."""
    from scanloom.stages.exports.formats import FORMATS  # which knows this module

    found: list[Path] = []
    for export in sorted(
        p for p in exports.iterdir() if p.is_dir() and p.name in FORMATS and p.name != "stac"
    ):
        found += sorted(p for p in export.rglob("*") if p.is_file())
    return found


def _asset(path: Path, item_folder: Path, title: str, roles: list[str]) -> Any:
    import pystac

    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    href = quote(Path(os.path.relpath(path.resolve(), item_folder.resolve())).as_posix())
    extra = {"file:size": path.stat().st_size, "file:checksum": SHA256_MULTIHASH + digest}
    return pystac.Asset(href, title=title, media_type=media_type(path), roles=roles, extra_fields=extra)


def media_type(path: Path) -> str:
    """By the ending, the longest that is known."""
    matching = [ending for ending in MEDIA_TYPES if path.name.lower().endswith(ending)]
    return MEDIA_TYPES[max(matching, key=len)] if matching else UNKNOWN
