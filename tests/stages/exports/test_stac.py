"""The catalogue item, read and validated by pystac against the schemas it brings."""

from __future__ import annotations

import hashlib
import json
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.frames import Georeference
from scanloom.stages.exports.antimeridian import area_geometry, bounding_box
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.stac import convex_hull, media_type, write_stac
from scanloom.stages.geometry.geodesy import world_to_geodetic, world_to_projected
from scanloom.workflows.export_map import export_map
from tests.stages.exports.tracks import CAPE_TOWN, FIJI, MUNICH, START_NS, delivered, plane, poses_along, way

pystac = pytest.importorskip("pystac")
shapely = pytest.importorskip("shapely")


def map_of(folder: Path, origin: Georeference | None, points: np.ndarray | None = None) -> MapSource:
    sessions = {
        "a": poses_along(way(20), origin),
        "b": poses_along(way(5), origin, start_ns=START_NS + 10**12),
    }
    source = delivered(folder, origin, sessions, plane(3000) if points is None else points)
    (folder / "map.ply").write_text("ply\n")
    (folder / "report.html").write_text("<html></html>")
    return source


def item_of(source: MapSource, formats: str = "stac", options: Options | None = None):
    export_map(source.folder, formats, options or Options())
    item = pystac.Item.from_file(str(source.folder / "exports/stac/item.json"))
    item.stac_extensions, extensions = [], item.stac_extensions
    item.validate()  # the core's schemas come with pystac; those of extensions lie on the network
    item.stac_extensions = extensions
    return item


@pytest.mark.parametrize("origin", [MUNICH, CAPE_TOWN], ids=["north", "south"])
def test_place_and_time(tmp_path: Path, origin: Georeference) -> None:
    points = plane(3000)
    item = item_of(map_of(tmp_path / "m", origin, points))
    assert item.id == "m"
    latitude, longitude, height = world_to_geodetic(origin, points).T
    area = shapely.from_geojson(json.dumps(item.geometry))
    assert area.geom_type == "Polygon" and area.is_valid and area.exterior.is_ccw
    grown = area.buffer(1e-9)
    assert shapely.contains_xy(grown, longitude, latitude).all()
    hull = shapely.multipoints(np.column_stack((longitude, latitude))).convex_hull
    assert hull.area < area.area < 1.1 * hull.area
    west, south, low, east, north, high = item.bbox
    assert (west, south, east, north) == pytest.approx(area.bounds)
    # The box of each tile holds its corners, which reach above the plane itself.
    assert low <= height.min() < low + 3.0 and high >= height.max() > high - 3.0
    assert item.datetime == datetime(2025, 10, 9, 8, 53, 20, 49951, UTC)
    start, end = item.common_metadata.start_datetime, item.common_metadata.end_datetime
    assert start == item.datetime
    assert (end - start).total_seconds() == pytest.approx(1000.4, abs=1e-5)


def test_projection_and_point_cloud(tmp_path: Path) -> None:
    points = plane(3000)
    item = item_of(map_of(tmp_path / "m", MUNICH, points))
    projection = pystac.extensions.projection.ProjectionExtension.ext(item)
    assert projection.code == f"EPSG:{MUNICH.epsg}"
    low, high = np.split(np.array(projection.bbox), 2)
    projected = world_to_projected(MUNICH, points)
    assert (low <= projected.min(axis=0) + 1e-6).all() and (high >= projected.max(axis=0) - 1e-6).all()
    assert (
        np.abs(low - projected.min(axis=0)).max() < 3.0 and np.abs(high - projected.max(axis=0)).max() < 3.0
    )
    cloud = pystac.extensions.pointcloud.PointcloudExtension.ext(item)
    assert cloud.count == 3000
    assert cloud.type == "lidar" and cloud.encoding == "Parquet"
    schemas = {schema.name: (schema.size, schema.type) for schema in cloud.schemas}
    assert schemas["x_m"] == (4, "floating") and schemas["first_ns"] == (8, "signed")
    assert schemas["class"] == (1, "unsigned") and schemas["normal_z"] == (1, "signed")
    # The fields that version 1.0.0 of the extension's schema requires, of the types it requires.
    required = {"pc:count": int, "pc:type": str, "pc:encoding": str, "pc:schemas": list}
    assert all(type(item.properties[name]) is kind for name, kind in required.items())


def test_every_file_is_an_asset(tmp_path: Path) -> None:
    source = map_of(tmp_path / "m", MUNICH)
    item = item_of(source, "stac,tum,kitti,gpx,geojson,geoparquet")
    exported = {
        f"exports/{p.relative_to(source.folder / 'exports').as_posix()}"
        for p in (source.folder / "exports").rglob("*")
        if p.is_file() and p.parent.name in {"tum", "kitti", "gpx", "geojson", "geoparquet"}
    }
    assert len(exported) == 2 + 5 + 1 + 1 + 1
    assert exported <= set(item.assets)
    assert {"map.ply", "report.html", "tiles/index.parquet"} <= set(item.assets)
    for asset in item.assets.values():
        content = Path(asset.get_absolute_href()).read_bytes()
        assert asset.extra_fields["file:size"] == len(content)
        assert asset.extra_fields["file:checksum"] == "1220" + hashlib.sha256(content).hexdigest()
        assert re.fullmatch("[a-f0-9]+", asset.extra_fields["file:checksum"])
        assert not Path(asset.href).is_absolute()
        assert asset.media_type and asset.title and asset.roles
    assert item.assets["exports/gpx/trajectory.gpx"].extra_fields["proj:code"] == "EPSG:4326"
    assert item.assets["exports/tum/a.tum"].extra_fields["proj:code"] is None
    assert "proj:code" not in item.assets["exports/geoparquet/trajectory.parquet"].extra_fields


def test_exports_of_another_map_are_no_assets(tmp_path: Path) -> None:
    source = map_of(tmp_path / "m", MUNICH)
    assert "exports/tum/a.tum" in item_of(source, "tum,stac").assets
    header = source.folder / "map.json"
    header.write_text(json.dumps(json.loads(header.read_text()) | {"version": 2}))
    item = item_of(MapSource.open(source.folder), "stac,gpx")
    assert "exports/tum/a.tum" not in item.assets
    assert "exports/gpx/trajectory.gpx" in item.assets


def test_a_new_report_has_a_new_checksum(tmp_path: Path) -> None:
    source = map_of(tmp_path / "m", MUNICH)
    item_of(source)
    (source.folder / "report.html").write_text("<p></p>")
    item = item_of(source)
    digest = hashlib.sha256(b"<p></p>").hexdigest()
    assert item.assets["report.html"].extra_fields["file:checksum"] == "1220" + digest


def test_over_the_date_line(tmp_path: Path) -> None:
    item = item_of(map_of(tmp_path / "m", FIJI))
    west, _, _, east, _, _ = item.bbox
    assert 179.0 < west < 180.0 and -180.0 < east < -179.0
    assert item.geometry["type"] == "MultiPolygon"
    for ring in (polygon[0] for polygon in item.geometry["coordinates"]):
        assert len({longitude > 0.0 for longitude, _ in ring}) == 1
    area = shapely.from_geojson(json.dumps(item.geometry))
    assert area.is_valid and all(part.exterior.is_ccw for part in area.geoms)


def test_what_lies_nowhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="has no georeference"):
        write_stac(map_of(tmp_path / "a", None), tmp_path, Options())
    without_poses = delivered(tmp_path / "b", MUNICH, {"a": poses_along(way(0), MUNICH)})
    with pytest.raises(InvalidInput, match="no trajectory"):
        write_stac(without_poses, tmp_path, Options())


def test_one_point_has_an_area(tmp_path: Path) -> None:
    item = item_of(map_of(tmp_path / "m", MUNICH, np.array([[1.0, 2.0, 3.0]])))
    area = shapely.from_geojson(json.dumps(item.geometry))
    assert area.is_valid and 0.0 < area.area < 1e-10


def test_hull_of_random_points_is_that_of_shapely() -> None:
    points = np.random.default_rng(2).normal(size=(200, 2))
    ours = shapely.polygons(convex_hull(points))
    assert ours.equals(shapely.multipoints(points).convex_hull)
    assert ours.exterior.is_ccw
    assert len(convex_hull(np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5]]))) <= 2


def test_a_cut_area_loses_nothing() -> None:
    ring = np.array([[179.0, -1.0], [181.5, -1.0], [181.0, 1.0], [179.5, 1.0]])
    parts = shapely.from_geojson(json.dumps(area_geometry(ring)))
    assert parts.area == pytest.approx(shapely.polygons(ring).area)
    assert bounding_box(ring) == [179.0, -1.0, -178.5, 1.0]
    assert area_geometry(ring - [10.0, 0.0])["type"] == "Polygon"


def test_longest_ending_wins() -> None:
    assert media_type(Path("a.copc.laz")) == "application/vnd.laszip+copc"
    assert media_type(Path("a.LAZ")) == "application/vnd.laszip"
    assert media_type(Path("a.unheard")) == "application/octet-stream"
