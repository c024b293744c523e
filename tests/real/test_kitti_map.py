"""KITTI 0005 from the raw folder to a georeferenced map: 100 scans, 39 m, GNSS good to half a metre."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import duckdb
import numpy as np
import pyarrow.parquet as pq
import pytest
from pyproj import Transformer


@pytest.fixture(scope="module")
def kitti(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map's folder."""
    folder = tmp_path_factory.mktemp("kitti")
    words = ["map", str(shared_data / "kitti_raw_0005"), "--out", "out"]
    done = subprocess.run(
        [sys.executable, "-m", "scanloom.workflows.cli", *words],
        cwd=folder, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "out"


def _values(out: Path) -> dict[str, float]:
    return {row["name"]: row["value"] for row in json.loads((out / "metrics.json").read_text())}


def test_every_scan_has_a_pose_and_the_path_its_length(kitti: Path) -> None:
    tum = np.loadtxt(kitti / "trajectory.tum")
    assert len(tum) == 100
    length = np.linalg.norm(np.diff(tum[:, 1:4], axis=0), axis=1).sum()
    assert length == pytest.approx(38.9, rel=0.02)
    assert _values(kitti)["odometry.path_length_m"] == pytest.approx(38.9, rel=0.02)


def test_error_against_oxts(kitti: Path) -> None:
    assert 0.05 < _values(kitti)["fusion.ate_rmse_m"] <= 1.0


def test_map_is_georeferenced(kitti: Path) -> None:
    described = json.loads((kitti / "map.json").read_text())
    assert described["epsg"] == 32632
    origin = described["origin"]
    assert origin["latitude_deg"] == pytest.approx(49.011, abs=0.002)
    assert origin["longitude_deg"] == pytest.approx(8.423, abs=0.005)
    assert 400_000 < origin["easting_m"] < 500_000
    assert 5_400_000 < origin["northing_m"] < 5_500_000


def test_tiles_open_in_pyarrow_and_duckdb(kitti: Path) -> None:
    index = pq.read_table(kitti / "tiles/index.parquet")
    counted: dict[str, int] = {}
    for name, points in zip(index["tile"].to_pylist(), index["points"].to_pylist(), strict=True):
        counted[name] = counted.get(name, 0) + points
    for name, points in counted.items():
        path = kitti / f"tiles/{name}.parquet"
        assert pq.read_table(path).num_rows == points
        found = duckdb.sql(f"select count(*) from '{path}' where isfinite(x_m) and isfinite(z_m)").fetchall()
        assert found == [(points,)]


def test_ply_opens_in_open3d(kitti: Path) -> None:
    code = (
        "import open3d as o3d, sys; c = o3d.t.io.read_point_cloud(sys.argv[1]); "
        "print(len(c.point.positions), float(c.point.positions.numpy().max()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(kitti / "map.ply")],
        capture_output=True, text=True, timeout=120, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    count, furthest = done.stdout.split()[-2:]
    assert int(count) > 100_000
    assert 20 < float(furthest) < 300


CLOUDS = ("ply", "pcd", "laz", "copc", "autoware")


@pytest.fixture(scope="module")
def exported(kitti: Path) -> Path:
    """The map as every kind of point cloud."""
    pytest.importorskip("laspy")
    words = ["export", str(kitti), "--format", ",".join(CLOUDS)]
    done = subprocess.run(
        [sys.executable, "-m", "scanloom.workflows.cli", *words], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return kitti / "exports"


def tiles_of(folder: Path) -> list[Path]:
    names = dict.fromkeys(pq.read_table(folder / "tiles/index.parquet")["tile"].to_pylist())
    return [folder / f"tiles/{name}.parquet" for name in names]


@pytest.fixture(scope="module")
def placed(kitti: Path) -> np.ndarray:
    """All points (n, 3) of the map in UTM, by PROJ alone."""
    described = json.loads((kitti / "map.json").read_text())
    origin = described["origin"]
    into_utm = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lon_0={origin['longitude_deg']!r} +lat_0={origin['latitude_deg']!r} +h_0={origin['height_m']!r} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=32 +ellps=WGS84"
    )
    parts = []
    for path in tiles_of(kitti):
        table = pq.read_table(path, columns=["x_m", "y_m", "z_m"])
        corner = [described["tile_size_m"] * int(number) for number in path.stem.split("_")]
        x, y, z = (table[column].to_numpy().astype(float) for column in table.column_names)
        parts.append(np.column_stack(into_utm.transform(x + corner[0], y + corner[1], z)))
    return np.concatenate(parts)


def test_laz_is_the_map(exported: Path, placed: np.ndarray, kitti: Path) -> None:
    import laspy

    found = laspy.read(exported / "laz/map.laz")
    assert len(found.points) == len(placed)
    assert np.abs(found.xyz - placed).max() < 0.00052
    assert found.header.parse_crs().to_2d().to_epsg() == 32632
    # GPS time was 15 s ahead of UTC in 2011. KITTI's stamps carry no zone; the log's own are taken for UTC.
    first = datetime.fromtimestamp(found.gps_time.min() + 1e9 - 15 + 315_964_800, UTC)
    stamp_ns = min(
        pq.read_table(path, columns=["first_ns"])["first_ns"].to_numpy().min(initial=2**62)
        for path in tiles_of(kitti)
    )
    assert first.date().isoformat() == "2011-09-26"
    assert abs(first.timestamp() - stamp_ns / 1e9) < 1e-5


def test_copc_is_the_map(exported: Path, placed: np.ndarray) -> None:
    import laspy

    with laspy.CopcReader.open(str(exported / "copc/map.copc.laz")) as reader:
        found = reader.query()
        assert len(found) == reader.header.point_count == len(placed)
        assert np.abs(reader.header.mins - placed.min(axis=0)).max() < 0.00052
        assert np.abs(reader.header.maxs - placed.max(axis=0)).max() < 0.00052
        assert reader.header.parse_crs().to_2d().to_epsg() == 32632
        mean = np.column_stack((found.x, found.y, found.z)).mean(axis=0)
        assert np.abs(mean - placed.mean(axis=0)).max() < 1e-4
        assert 1000 < len(reader.query(level=0)) < len(placed) / 4


@pytest.mark.parametrize("name", ["ply", "pcd"])
def test_single_clouds_are_the_map(exported: Path, placed: np.ndarray, name: str) -> None:
    import open3d as o3d

    found = np.asarray(o3d.io.read_point_cloud(str(exported / f"{name}/map.{name}")).points)
    offset = json.loads((exported / f"{name}/map.json").read_text())["offset_m"]
    assert len(found) == len(placed)
    assert np.abs(found + offset - placed).max() < 2e-5


def test_cells_of_autoware_are_the_map(exported: Path, placed: np.ndarray, kitti: Path) -> None:
    import open3d as o3d

    cells = sorted((exported / "autoware/pointcloud_map.pcd").iterdir())
    found = np.concatenate([np.asarray(o3d.io.read_point_cloud(str(cell)).points) for cell in cells])
    origin = json.loads((kitti / "map.json").read_text())["origin"]
    local = placed - [origin["easting_m"], origin["northing_m"], 0.0]
    assert len(found) == len(placed)
    assert np.abs(found.min(axis=0) - local.min(axis=0)).max() < 2e-5
    assert np.abs(found.max(axis=0) - local.max(axis=0)).max() < 2e-5
    assert np.abs(found.mean(axis=0) - local.mean(axis=0)).max() < 1e-5


def test_nothing_is_exported_twice(exported: Path, kitti: Path) -> None:
    words = ["export", str(kitti), "--format", ",".join(CLOUDS), "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "scanloom.workflows.cli", *words], capture_output=True, text=True, timeout=300
    )
    assert [row["fresh"] for row in json.loads(done.stdout)] == [False] * len(CLOUDS)


OTHERS = ("tum", "kitti", "gpx", "geojson", "geoparquet", "dem", "orthophoto", "stac")


@pytest.fixture(scope="module")
def others(kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map as everything that is no point cloud."""
    for library in ("rasterio", "pystac"):
        pytest.importorskip(library)
    out = tmp_path_factory.mktemp("others")
    words = ["export", str(kitti), "--format", ",".join(OTHERS), "--out", str(out)]
    done = subprocess.run(
        [sys.executable, "-m", "scanloom.workflows.cli", *words], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return out


def trajectory_of(kitti: Path) -> np.ndarray:
    """Stamp in s and position (n, 4) of every scan, in the map's frame."""
    return np.loadtxt(kitti / "trajectory.tum")[:, :4]


def test_text_trajectories_are_the_trajectory(others: Path, kitti: Path) -> None:
    files = pytest.importorskip("evo.tools.file_interface")
    (tum,) = (others / "tum").iterdir()
    want = trajectory_of(kitti)
    read = files.read_tum_trajectory_file(tum)
    np.testing.assert_allclose(read.positions_xyz, want[:, 1:], rtol=0.0, atol=1e-6)
    assert np.abs(read.timestamps - want[:, 0]).max() < 1e-6
    matrices = files.read_kitti_poses_file(others / f"kitti/{tum.stem}.txt")
    np.testing.assert_allclose(matrices.positions_xyz, want[:, 1:], rtol=0.0, atol=1e-6)


def test_geographic_trajectories_are_one_and_the_same(others: Path, kitti: Path) -> None:
    gpxpy, geopandas = pytest.importorskip("gpxpy"), pytest.importorskip("geopandas")
    (segment,) = gpxpy.parse((others / "gpx/trajectory.gpx").read_text()).tracks[0].segments
    track = np.array([(p.longitude, p.latitude, p.elevation) for p in segment.points])
    (feature,) = json.loads((others / "geojson/trajectory.geojson").read_text())["features"]
    line = np.array(feature["geometry"]["coordinates"])
    np.testing.assert_allclose(line, track, rtol=0.0, atol=1e-8)
    frame = geopandas.read_parquet(others / "geoparquet/trajectory.parquet")
    assert frame.crs.to_epsg() == 32632
    degrees = frame.geometry.to_crs(4326)
    np.testing.assert_allclose(np.column_stack((degrees.x, degrees.y)), track[:, :2], rtol=0.0, atol=2e-9)
    assert len(frame) == len(trajectory_of(kitti))
    assert frame.sigma_position_m.between(0.01, 5.0).all()


def test_heights_are_those_of_the_ground(others: Path, kitti: Path, placed: np.ndarray) -> None:
    import rasterio

    classes = [pq.read_table(path, columns=["class_"])["class_"].to_numpy() for path in tiles_of(kitti)]
    ground = placed[np.concatenate(classes) == 1]
    with rasterio.open(others / "dem/dem.tif") as dem, rasterio.open(others / "dem/dem_count.tif") as count:
        assert dem.crs.to_epsg() == count.crs.to_epsg() == 32632
        box = np.array(dem.bounds)
        assert np.abs(box - [*ground.min(axis=0)[:2], *ground.max(axis=0)[:2]]).max() <= 0.25
        counts, heights = count.read(1), dem.read(1)
        row, column = (np.floor(v / 0.25).astype(int) for v in (box[3] - ground[:, 1], ground[:, 0] - box[0]))
        here, sums = np.zeros(counts.shape, int), np.zeros(counts.shape)
        np.add.at(here, (row, column), 1)
        np.add.at(sums, (row, column), ground[:, 2])
        assert counts.sum() == len(ground)
        # A point within a hundredth of a millimetre of an edge may fall to either side.
        same = here == counts
        assert np.count_nonzero(~same) < 20
        known = same & (counts > 0)
        assert np.abs(heights[known] - sums[known] / here[known]).max() < 1e-3
        filled = (counts == 0) & (heights != dem.nodata)
        assert 0 < np.count_nonzero(filled) < np.count_nonzero(known)


def test_intensities_are_those_of_the_sensor(others: Path, placed: np.ndarray) -> None:
    import rasterio

    with rasterio.open(others / "orthophoto/intensity_top.tif") as top:
        box = np.array(top.bounds)
        assert np.abs(box - [*placed.min(axis=0)[:2], *placed.max(axis=0)[:2]]).max() <= 0.25
        numbers = top.read(1)
        intensity = top.offsets[0] + top.scales[0] * numbers[numbers > 0].astype(float)
        # KITTI's reflectances are from 0 to 1.
        assert intensity.min() > -1e-6 and 0.5 < intensity.max() <= 1.0 + 1e-6
        assert 0.1 < np.median(intensity) < 0.5


def test_the_catalogue_lists_the_map(others: Path, kitti: Path, placed: np.ndarray) -> None:
    import pystac

    item = pystac.Item.from_file(str(others / "stac/item.json"))
    assert item.properties["pc:count"] == len(placed)
    assert item.properties["proj:code"] == "EPSG:32632"
    low, high = np.split(np.array(item.properties["proj:bbox"]), 2)
    assert (low <= placed.min(axis=0) + 1e-6).all() and (high >= placed.max(axis=0) - 1e-6).all()
    assert np.abs(low - placed.min(axis=0)).max() < 1.0 and np.abs(high - placed.max(axis=0)).max() < 1.0
    into_utm = Transformer.from_crs(4326, 32632, always_xy=True)
    west, south = into_utm.transform(item.bbox[0], item.bbox[1])
    assert np.abs(low[:2] - [west, south]).max() < 5.0
    exported = {name for name in item.assets if name.startswith("exports/")}
    assert {name.split("/")[1] for name in exported} == set(OTHERS) - {"stac"}
    assert all(Path(asset.get_absolute_href()).is_file() for asset in item.assets.values())
    assert {"map.ply", "report.html"} <= set(item.assets)
