"""KITTI 0005 from the raw folder to a georeferenced map: 100 scans, 39 m, GNSS good to half a metre."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import duckdb
import numpy as np
import pyarrow.parquet as pq
import pytest


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
