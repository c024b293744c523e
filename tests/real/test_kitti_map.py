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
    for name, points in zip(index["tile"].to_pylist(), index["points"].to_pylist(), strict=True):
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
        pq.read_table(path, columns=["first_ns"])["first_ns"].to_numpy().min() for path in tiles_of(kitti)
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
