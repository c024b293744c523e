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
from scanloom.stages.exports.source import HEADER, MapSource
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
RECORD = "exports.json"
"""What the exports of a map are on record in, beside their folders."""
WITH_A_SYSTEM_OF_ITS_OWN: dict[str, str | None] = {
    "tum": None,
    "kitti": None,
    "gpx": "EPSG:4326",
    "geojson": "EPSG:4326",
    "3dtiles": "EPSG:4978",
    "autoware": None,
}
LOOKED_AT = {".html", ".png", ".json"}
"""Files that have no coordinates."""
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

    The exports are those that are on record beside `folder` when this one is written, made from this very map.

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
    for key, asset in _assets(source, folder, _code(projector.epsg, projector.vertical_epsg)):
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
    low, high = source.index.filled.min_m, source.index.filled.max_m
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
    corners = projector.project(_corners(source))
    code = _code(projector.epsg, projector.vertical_epsg)
    return {
        "title": source.name,
        "proj:code": code,
        **({} if code else {"proj:projjson": projector.plain_crs.to_json_dict()}),
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


def _assets(source: MapSource, item_folder: Path, code: str | None) -> Iterator[tuple[str, Any]]:
    """Key and asset of each delivered and each exported file, in order."""
    delivered = [name for name in source.header.get("files", {}) if name.startswith("trajectory/")]
    about = DELIVERED | dict.fromkeys(sorted(delivered), DELIVERED["trajectory.parquet"])
    for name, (title, roles) in about.items():
        path = source.folder / name
        if path.is_file() and path.suffix != ".tum":
            place: dict[str, Any] = {} if path.suffix in LOOKED_AT else {"proj:code": None}
            known = source.header.get("files", {}).get(name, {})
            yield name, _asset(path, item_folder, title, roles, known, place)
    for export, row in exports_of(source, item_folder.parent).items():
        for name, known in row["files"].items():
            path = item_folder.parent / export / name
            role = "metadata" if path.suffix in {".txt", ".yaml"} else "data"
            at = WITH_A_SYSTEM_OF_ITS_OWN.get(export, _code(row["crs"]["epsg"], row["crs"]["vertical_epsg"]))
            place = {} if at == code else {"proj:code": at}
            title = f"{export}: {row.get('what', name)}"
            yield f"exports/{export}/{name}", _asset(path, item_folder, title, [role], known, place)


def exports_of(source: MapSource, exports: Path) -> dict[str, Any]:
    """Rows of the record of exports that were made from this very map, by format, without the catalogue's own."""
    try:
        rows = json.loads((exports / RECORD).read_text())["formats"]
    except (OSError, ValueError, KeyError):
        return {}
    header = hashlib.sha256((source.folder / HEADER).read_bytes()).hexdigest()
    made = {name: row for name, row in sorted(rows.items()) if row["made_from"]["map"] == header}
    return {name: row for name, row in made.items() if name != "stac"}


def _code(epsg: int | None, vertical_epsg: int | None) -> str | None:
    """As `EPSG:32632`; None where no single code says it all."""
    return None if epsg is None or vertical_epsg is not None else f"EPSG:{epsg}"


def _asset(
    path: Path, item_folder: Path, title: str, roles: list[str], known: dict[str, Any], place: dict[str, Any]
) -> Any:
    """known : the file's checksum and size as they are on record; without them it is read."""
    import pystac

    size = path.stat().st_size
    digest = known.get("sha256")
    if known.get("bytes") != size or not digest:
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    href = quote(Path(os.path.relpath(path.resolve(), item_folder.resolve())).as_posix())
    extra = {"file:size": size, "file:checksum": f"{SHA256_MULTIHASH}{digest}", **place}
    return pystac.Asset(href, title=title, media_type=media_type(path), roles=roles, extra_fields=extra)


def media_type(path: Path) -> str:
    """By the ending, the longest that is known."""
    matching = [ending for ending in MEDIA_TYPES if path.name.lower().endswith(ending)]
    return MEDIA_TYPES[max(matching, key=len)] if matching else UNKNOWN
