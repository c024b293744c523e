"""GeoParquet read by geopandas and duckdb; its metadata against the text of version 1.1 of the standard."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest

from scanloom.schemas.frames import Georeference
from scanloom.stages.exports.geoparquet import sigmas, write_geoparquet
from scanloom.stages.exports.options import Options
from scanloom.stages.geometry.geodesy import world_to_projected
from scanloom.stages.geometry.se3 import pose, so3_exp
from tests.stages.exports.tracks import CAPE_TOWN, MUNICH, START_NS, delivered, poses_along, way


def written(
    folder: Path,
    origin: Georeference | None,
    options: Options | None = None,
    scans: tuple[int, ...] = (20, 9),
) -> tuple[Path, dict]:
    sessions = {
        name: poses_along(way(n), origin, start_ns=START_NS + i * 10**12)
        for i, (name, n) in enumerate(zip("abc", scans))
    }
    (path,) = write_geoparquet(delivered(folder / "m", origin, sessions), folder, options or Options())
    return path, sessions


@pytest.mark.parametrize("origin", [MUNICH, CAPE_TOWN], ids=["north", "south"])
def test_geopandas_reads_it(tmp_path: Path, origin: Georeference) -> None:
    geopandas = pytest.importorskip("geopandas")
    path, sessions = written(tmp_path, origin)
    frame = geopandas.read_parquet(path)
    assert frame.crs.to_epsg() == origin.epsg
    assert len(frame) == 29
    for name, poses in sessions.items():
        rows = frame[frame.session == name]
        got = np.column_stack((rows.geometry.x, rows.geometry.y, rows.geometry.z))
        want = world_to_projected(origin, poses.T_world_lidar[:, :3, 3])
        np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-6)
        assert rows.stamp.astype("int64").tolist() == poses.stamp_ns.tolist()
        assert rows.keyframe.tolist() == poses.keyframe.tolist()
    np.testing.assert_allclose(frame.total_bounds, [*_low(frame)[:2], *_high(frame)[:2]])


def _low(frame) -> list[float]:
    return [frame.geometry.x.min(), frame.geometry.y.min(), frame.geometry.z.min()]


def _high(frame) -> list[float]:
    return [frame.geometry.x.max(), frame.geometry.y.max(), frame.geometry.z.max()]


def test_duckdb_reads_it(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    path, _ = written(tmp_path, MUNICH)
    rows = duckdb.sql(
        "select session, count(*), min(scan_index), max(epoch_ns(stamp)) - min(epoch_ns(stamp)), "
        f"min(geometry::varchar), typeof(any_value(geometry)) from '{path}' group by session order by session"
    ).fetchall()
    assert [row[:4] for row in rows] == [("a", 20, 0, 1_900_000_000), ("b", 9, 0, 800_000_000)]
    for text, kind in (row[4:] for row in rows):
        assert kind.startswith("GEOMETRY") and "UTM zone 32N" in kind
        got = [float(number) for number in text.removeprefix("POINT Z (").removesuffix(")").split()]
        assert np.abs(np.array(got) - [MUNICH.easting_m, MUNICH.northing_m, MUNICH.height_m]).max() < 150.0


def test_metadata_follow_the_standard(tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    path, sessions = written(tmp_path, MUNICH)
    file = pq.ParquetFile(path)
    geo = json.loads(file.schema_arrow.metadata[b"geo"])
    assert geo["version"] == "1.1.0" and geo["primary_column"] == "geometry"
    assert set(geo) == {"version", "primary_column", "columns"}
    column = geo["columns"]["geometry"]
    assert column["encoding"] == "WKB" and column["edges"] == "planar"
    assert column["geometry_types"] == ["Point Z"]
    places = np.vstack(
        [world_to_projected(MUNICH, poses.T_world_lidar[:, :3, 3]) for poses in sessions.values()]
    )
    bounds = np.concatenate((places.min(axis=0), places.max(axis=0)))
    np.testing.assert_allclose(column["bbox"], bounds, rtol=0.0, atol=1e-6)
    schema = json.loads((Path(pyproj.datadir.get_data_dir()) / "projjson.schema.json").read_text())
    jsonschema.validate(column["crs"], schema)
    geometry = file.schema.column(file.schema_arrow.get_field_index("geometry"))
    assert geometry.physical_type == "BYTE_ARRAY"
    assert file.num_row_groups == 2


def test_wkb_is_iso_little_endian(tmp_path: Path) -> None:
    path, sessions = written(tmp_path, None, scans=(2,))
    first = pq.read_table(path)["geometry"][0].as_py()
    assert len(first) == 29
    assert first[:5] == bytes([1, 0xE9, 3, 0, 0])
    np.testing.assert_array_equal(np.frombuffer(first[5:]), sessions["a"].T_world_lidar[0, :3, 3])


def test_another_system_on_request(tmp_path: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    path, sessions = written(tmp_path, MUNICH, Options(epsg=25832))
    frame = geopandas.read_parquet(path)
    assert frame.crs.to_epsg() == 25832
    want = world_to_projected(MUNICH, sessions["a"].T_world_lidar[:1, :3, 3])[0]
    # ETRS89 and WGS84 are the same to a metre; UTM is the same projection.
    assert np.abs(frame.geometry.iloc[0].x - want[0]) < 1.0


def test_a_map_without_georeference_says_so(tmp_path: Path) -> None:
    path, _ = written(tmp_path, None)
    geo = json.loads(pq.read_schema(path).metadata[b"geo"])
    assert geo["columns"]["geometry"]["crs"] is None
    assert pq.read_table(path).num_rows == 29


@pytest.mark.parametrize("scans", [(0,), (1,), (0, 1, 3)])
def test_short_sessions(tmp_path: Path, scans: tuple[int, ...]) -> None:
    geopandas = pytest.importorskip("geopandas")
    path, _ = written(tmp_path, MUNICH, scans=scans)
    assert len(geopandas.read_parquet(path)) == sum(scans)
    geo = json.loads(pq.read_schema(path).metadata[b"geo"])
    assert ("bbox" in geo["columns"]["geometry"]) == (sum(scans) > 0)


def test_sigmas_are_along_the_axes_of_the_map() -> None:
    poses = poses_along(way(1), None, yaw_rad=np.pi / 2)
    position, heading = sigmas(poses)
    np.testing.assert_allclose(position[0], [0.2, 0.1, 0.3], atol=1e-12)
    assert heading[0] == pytest.approx(2e-3)


def test_sigmas_match_samples_of_the_tangent() -> None:
    poses = poses_along(way(1), None)
    T = pose(so3_exp([0.4, -0.3, 1.0]), [1.0, 2.0, 3.0])
    poses.T_world_lidar[0] = T
    rng = np.random.default_rng(3)
    xi = rng.multivariate_normal(np.zeros(6), poses.covariance[0], 200_000)
    moved = xi[:, 3:] @ T[:3, :3].T
    position, _ = sigmas(poses)
    np.testing.assert_allclose(moved.std(axis=0), position[0], rtol=0.01)
