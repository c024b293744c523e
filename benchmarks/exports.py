"""Exports: every format of a map, opened by a program that is not ours, and held against the map.

`python -m benchmarks.exports MAP ... [--out FOLDER] [--json -]` exports each map to all formats and prints a line for each file: who
read it, how many points (scans, cells) it found, whether its bounds and its coordinate system are those of the map. Bounds
are held against the map's points as PROJ places them, those of trajectories against its poses.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from scanloom.schemas.scans import PointClass
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.formats import FORMATS
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.orthophoto import TOP_M
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import ecef_pose, world_to_geodetic
from scanloom.workflows.export_map import export_all

MILLIMETRE = 0.002
"""Whole millimetres, and float32 from an offset: what the formats themselves can say, m."""
DEGREES = 2e-9 * 90.0
"""The same in degrees, rounded up to what GPX writes."""
NOWHERE = ("gpx", "geojson", "stac")
"""Formats that need a place on the Earth."""


@dataclass(frozen=True)
class Truth:
    """What the map holds, in the systems of its exports."""

    source: MapSource
    projected: np.ndarray
    """(n, 3) points in the projected system."""
    poses: np.ndarray
    """(m, 3) of all sessions, in the map's frame."""
    ground: int
    coloured: np.ndarray
    """(n,) whether an image saw it."""
    epsg: int | None

    @classmethod
    def of(cls, folder: Path) -> Truth:
        source = MapSource.open(folder)
        projector = Projector.of(source, Options())
        tiles = [tile for _, tile in source.tiles()]
        xyz = [np.column_stack((t.x_m, t.y_m, t.z_m)) + np.array(t.offset_m) for t in tiles]
        tracks = [table.T_world_lidar[:, :3, 3] for table in source.trajectories().values()]
        ground = sum(int(np.count_nonzero(t.class_ == PointClass.GROUND)) for t in tiles)
        placed = projector.project(np.concatenate(xyz))
        coloured = np.concatenate([t.views > 0 for t in tiles])
        return cls(source, placed, np.concatenate(tracks), ground, coloured, projector.epsg)

    @property
    def track(self) -> np.ndarray:
        """Poses in the projected system (m, 3)."""
        return Projector.of(self.source, Options()).project(self.poses)

    @property
    def geodetic(self) -> np.ndarray:
        """Poses as longitude, latitude, height (m, 3)."""
        return world_to_geodetic(self.source.georeference, self.poses)[:, [1, 0, 2]]


@dataclass(frozen=True)
class Seen:
    """What a reader found in an export."""

    reader: str
    count: int
    expected: int
    bounds: bool
    crs: bool | None
    """None where the format has no place for it."""

    def __bool__(self) -> bool:
        return self.count == self.expected and self.bounds and self.crs is not False


def same(low: Any, high: Any, truth: np.ndarray, off: float = MILLIMETRE) -> bool:
    """Whether bounds are those of points."""
    wide = truth.shape[1]
    ends = truth.min(axis=0), truth.max(axis=0)
    return all(np.abs(np.asarray(a, float)[:wide] - b).max() < off for a, b in zip((low, high), ends))


def open3d_clouds(reader: str, paths: list[Path], offset: np.ndarray, truth: Truth, crs: bool | None) -> Seen:
    import open3d

    points = np.concatenate([np.asarray(open3d.io.read_point_cloud(str(path)).points) for path in paths])
    points = points + offset
    bounds = same(points.min(axis=0), points.max(axis=0), truth.projected)
    return Seen(reader, len(points), len(truth.projected), bounds, crs)


def placement(folder: Path, truth: Truth) -> tuple[np.ndarray, bool | None]:
    beside = json.loads((folder / "map.json").read_text())
    return np.array(beside["offset_m"]), None if truth.epsg is None else beside["epsg"] == truth.epsg


def ply(folder: Path, truth: Truth) -> list[Seen]:
    return [
        open3d_clouds(
            "open3d", [folder / "map.ply"], *placement(folder, truth)[:1], truth, placement(folder, truth)[1]
        )
    ]


def pcd(folder: Path, truth: Truth) -> list[Seen]:
    offset, crs = placement(folder, truth)
    return [open3d_clouds("open3d", [folder / "map.pcd"], offset, truth, crs)]


def autoware(folder: Path, truth: Truth) -> list[Seen]:
    import yaml

    paths = sorted((folder / "pointcloud_map.pcd").glob("*.pcd"))
    listed = yaml.safe_load((folder / "pointcloud_map_metadata.yaml").read_text())
    assert {path.name for path in paths} == set(listed) - {"x_resolution", "y_resolution"}
    place = yaml.safe_load((folder / "map_projector_info.yaml").read_text())
    origin = Projector.of(truth.source, Options()).project(np.zeros((1, 3)))[0] * [1.0, 1.0, 0.0]
    crs = place["projector_type"] == ("Local" if truth.epsg is None else "LocalCartesianUTM")
    return [open3d_clouds("open3d, yaml", paths, origin if truth.epsg else np.zeros(3), truth, crs)]


def epsg_of(crs: Any) -> int | None:
    """Code of the horizontal system of a pyproj one."""
    from pyproj import CRS

    if crs is None:
        return None
    flat = CRS(crs)
    return flat.to_epsg() or flat.to_2d().to_epsg()


def laz(folder: Path, truth: Truth) -> list[Seen]:
    import copclib
    import laspy

    found = laspy.read(folder / "map.laz")
    crs = epsg_of(found.header.parse_crs()) == truth.epsg
    bounds = same(found.xyz.min(axis=0), found.xyz.max(axis=0), truth.projected)
    with_laspy = Seen("laspy", len(found.points), len(truth.projected), bounds, crs)
    reader = copclib.LazReader(str(folder / "map.laz"))
    header = reader.laz_config.las_header
    low, high = ((v.x, v.y, v.z) for v in (header.min, header.max))
    also = Seen("copclib", header.point_count, len(truth.projected), same(low, high, truth.projected), None)
    return [with_laspy, also]


def copc(folder: Path, truth: Truth) -> list[Seen]:
    import copclib
    import laspy

    with laspy.CopcReader.open(folder / "map.copc.laz") as reader:
        found = reader.query()
        crs = epsg_of(reader.header.parse_crs()) == truth.epsg
    xyz = np.column_stack((found.x, found.y, found.z))
    bounds = same(xyz.min(axis=0), xyz.max(axis=0), truth.projected)
    with_laspy = Seen("laspy", len(found), len(truth.projected), bounds, crs)
    opened = copclib.FileReader(str(folder / "map.copc.laz"))
    nodes = opened.GetAllNodes()
    low, high = (
        (v.x, v.y, v.z) for v in (opened.copc_config.las_header.min, opened.copc_config.las_header.max)
    )
    count = sum(node.point_count for node in nodes)
    also = Seen("copclib", count, len(truth.projected), same(low, high, truth.projected), None)
    return [with_laspy, also]


def tiles3d(folder: Path, truth: Truth) -> list[Seen]:
    import trimesh

    transform = json.loads((folder / "tileset.json").read_text())["root"].get("transform")
    contents = sorted(folder.rglob("*.glb"))
    parts = []
    for path in contents:
        (cloud,) = trimesh.load_scene(path).dump()
        v = np.asarray(cloud.vertices, float)
        parts.append(np.column_stack((v[:, 0], -v[:, 2], v[:, 1])))
    points = np.concatenate(parts)
    placed = Projector.of(truth.source, Options()).project(points)
    bounds = same(placed.min(axis=0), placed.max(axis=0), truth.projected)
    georeference = truth.source.georeference
    stands = transform is None if georeference is None else np.allclose(
        np.reshape(transform, (4, 4)).T, ecef_pose(georeference), rtol=0, atol=1e-6
    )  # fmt: skip
    return [Seen(f"trimesh ({len(contents)} files)", len(points), len(truth.projected), bounds, bool(stands))]


def with_py3dtiles(python: Path, folder: Path, truth: Truth) -> Seen:
    """py3dtiles needs an environment of its own."""
    script = Path(__file__).with_name("py3dtiles_reader.py")
    done = subprocess.run([python, "-I", script, folder], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    bounds = same(found["low"], found["high"], truth.source.index.bounds_m)
    return Seen(f"py3dtiles ({found['files']} files)", found["points"], len(truth.projected), bounds, None)


def tum(folder: Path, truth: Truth) -> list[Seen]:
    from evo.tools import file_interface

    found = [
        file_interface.read_tum_trajectory_file(str(p)).positions_xyz for p in sorted(folder.glob("*.tum"))
    ]
    points = np.concatenate(found)
    return [Seen("evo", len(points), len(truth.poses), same(points.min(0), points.max(0), truth.poses), None)]


def kitti(folder: Path, truth: Truth) -> list[Seen]:
    from evo.tools import file_interface

    paths = [p for p in sorted(folder.glob("*.txt")) if p.stem != "README" and not p.stem.endswith("_times")]
    points = np.concatenate([file_interface.read_kitti_poses_file(str(p)).positions_xyz for p in paths])
    return [Seen("evo", len(points), len(truth.poses), same(points.min(0), points.max(0), truth.poses), None)]


def gpx(folder: Path, truth: Truth) -> list[Seen]:
    import gpxpy

    found = gpxpy.parse((folder / "trajectory.gpx").read_text())
    rows = [(p.longitude, p.latitude) for t in found.tracks for s in t.segments for p in s.points]
    points = np.array(rows)
    bounds = same(points.min(axis=0), points.max(axis=0), truth.geodetic[:, :2], DEGREES)
    return [Seen("gpxpy", len(points), len(truth.poses), bounds, None)]


def geojson(folder: Path, truth: Truth) -> list[Seen]:
    import geopandas

    frame = geopandas.read_file(folder / "trajectory.geojson")
    count = sum(len(line.coords) for shape in frame.geometry for line in getattr(shape, "geoms", [shape]))
    west, south, east, north = frame.total_bounds
    bounds = same((west, south), (east, north), truth.geodetic[:, :2], DEGREES)
    return [Seen("geopandas", count, len(truth.poses), bounds, frame.crs.to_epsg() in (4326, 4979))]


def geoparquet(folder: Path, truth: Truth) -> list[Seen]:
    import duckdb
    import geopandas

    path = folder / "trajectory.parquet"
    frame = geopandas.read_parquet(path)
    x0, y0, x1, y1 = frame.total_bounds
    crs = epsg_of(frame.crs) == truth.epsg
    one = Seen("geopandas", len(frame), len(truth.poses), same((x0, y0), (x1, y1), truth.track[:, :2]), crs)
    counted = duckdb.sql(f"SELECT count(*) FROM '{path}'").fetchall()[0][0]
    return [one, Seen("duckdb", int(counted), len(truth.poses), True, None)]


def raster(path: Path, truth: Truth, count: int, band: int, expected: int) -> Seen:
    """A raster encloses the points it was made of, by less than a cell."""
    import rasterio

    with rasterio.open(path) as found:
        low, high = truth.projected[:, :2].min(axis=0), truth.projected[:, :2].max(axis=0)
        box, cell = found.bounds, found.res[0]
        near = np.array([low[0] - box.left, low[1] - box.bottom, box.right - high[0], box.top - high[1]])
        inside = bool((near > -1e-6).all() and (near < cell + 1e-6).all())
        crs = (found.crs.to_epsg() if found.crs else None) == truth.epsg
        return Seen("rasterio", count if band == 0 else int(found.read(band).sum()), expected, inside, crs)


def dem(folder: Path, truth: Truth) -> list[Seen]:
    return [ground_raster(folder, truth)]


def ground_raster(folder: Path, truth: Truth) -> Seen:
    import rasterio

    with rasterio.open(folder / "dem_count.tif") as found, rasterio.open(folder / "dem.tif") as heights:
        counted = int(found.read(1).astype(np.int64).sum())
        levels = heights.read(1, masked=True)
        crs = (heights.crs.to_epsg() if heights.crs else None) == truth.epsg
        low, high = truth.projected[:, 2].min(), truth.projected[:, 2].max()
        box = heights.bounds
        west, south = truth.projected[:, :2].min(axis=0) - heights.res[0]
        east, north = truth.projected[:, :2].max(axis=0) + heights.res[0]
        inside = west <= box.left and south <= box.bottom and box.right <= east and box.top <= north
        bounds = bool(inside and low - 1e-3 <= levels.min() and levels.max() <= high + 1e-3)
    return Seen("rasterio", counted, truth.ground, bounds, crs)


def orthophoto(folder: Path, truth: Truth) -> list[Seen]:
    import rasterio

    _, cell = np.unique(np.floor(truth.projected[:, :2] / 0.25).astype(np.int64), axis=0, return_inverse=True)
    with rasterio.open(folder / "intensity_top.tif") as found:
        filled = int(np.count_nonzero(found.read(1)))
    seen = [raster(folder / "intensity_top.tif", truth, filled, 0, int(cell.max()) + 1)]
    if not truth.coloured.any():
        return seen
    highest = np.full(int(cell.max()) + 1, -np.inf, np.float32)
    np.maximum.at(highest, cell.ravel(), truth.projected[:, 2].astype(np.float32))
    on_top = truth.coloured & (truth.projected[:, 2] > highest[cell.ravel()] - TOP_M)
    with rasterio.open(folder / "colour_top.tif") as found:
        filled = int(np.count_nonzero(found.read(4)))
    painted = len(np.unique(cell.ravel()[on_top]))
    return [*seen, raster(folder / "colour_top.tif", truth, filled, 0, painted)]


def stac(folder: Path, truth: Truth) -> list[Seen]:
    import pystac

    item = pystac.Item.from_file(str(folder / "item.json"))
    box = np.array(item.properties["proj:bbox"])
    low, high = truth.projected.min(axis=0), truth.projected.max(axis=0)
    encloses = bool((box[:3] <= low + MILLIMETRE).all() and (box[3:] >= high - MILLIMETRE).all())
    crs = item.properties.get("proj:code") == f"EPSG:{truth.epsg}"
    return [Seen("pystac", int(item.properties["pc:count"]), len(truth.projected), encloses, crs)]


READERS: dict[str, Callable[[Path, Truth], list[Seen]]] = {
    "ply": ply, "pcd": pcd, "laz": laz, "copc": copc, "autoware": autoware, "3dtiles": tiles3d, "tum": tum, "kitti": kitti,
    "gpx": gpx, "geojson": geojson, "geoparquet": geoparquet, "dem": dem, "orthophoto": orthophoto, "stac": stac,
}  # fmt: skip


def checked(folder: Path, place: Path, python: Path | None = None) -> list[tuple[str, Seen]]:
    """Export a map to everything it can be exported to, and open each."""
    truth = Truth.of(folder)
    names = [name for name in FORMATS if truth.epsg is not None or name not in NOWHERE]
    done, failures = export_all(folder, ",".join(names), Options(), place)
    assert not failures, failures
    rows = [
        (entry.name, seen)
        for entry in sorted(done, key=lambda e: names.index(e.name))
        for seen in READERS[entry.name](entry.folder, truth)
    ]

    if python is not None:
        rows.append(("3dtiles", with_py3dtiles(python, place / "3dtiles", truth)))
    return rows


def table(name: str, rows: list[tuple[str, Seen]]) -> Table:
    words = {True: "equal", False: "DIFFERENT", None: "-"}
    shown = Table("format", "read by", "points, scans, cells", "of the map", "bounds", "system", title=name)
    for format_, seen in rows:
        counts = f"{seen.count:,}", "equal" if seen.count == seen.expected else f"{seen.expected:,}"
        shown.add_row(format_, seen.reader, *counts, words[seen.bounds], words[seen.crs])
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("maps", nargs="+", type=Path, help="folders of finished maps")
    parser.add_argument("--out", type=Path, help="where the exports stay, a folder for each map")
    parser.add_argument("--py3dtiles", type=Path, help="Python of an environment with py3dtiles")
    parser.add_argument("--json", default="", help="file, or - for standard output")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for folder in options.maps:
            found = checked(folder, (options.out or Path(scratch)) / folder.name, options.py3dtiles)
            rows += [
                {"map": folder.name, "format": name, **vars(seen), "equal": bool(seen)}
                for name, seen in found
            ]
            if options.json != "-":
                Console(width=120).print(table(folder.name, found))
    text = json.dumps(rows, indent=1)
    if options.json == "-":
        print(text)
    elif options.json:
        Path(options.json).write_text(text + "\n")
    if not all(row["equal"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
