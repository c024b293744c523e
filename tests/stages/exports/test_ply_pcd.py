"""PLY and PCD, read with open3d."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.pcd import write_pcd
from scanloom.stages.exports.ply import write_ply
from tests.stages.exports.clouds import MUNICH, PUNTA_ARENAS, add_removed, column, expected, scattered, write


def read(path: Path) -> dict[str, np.ndarray]:
    import open3d as o3d

    cloud = o3d.t.io.read_point_cloud(str(path))
    return {name: value.numpy() for name, value in cloud.point.items()}


def offset(path: Path) -> np.ndarray:
    return np.array(json.loads(path.with_suffix(".json").read_text())["offset_m"])


@pytest.mark.parametrize("write_format", [write_ply, write_pcd])
@pytest.mark.parametrize(
    ("origin", "far_m"),
    [(MUNICH, (0.0, 0.0)), (PUNTA_ARENAS, (0.0, 0.0)), (MUNICH, (-60_000.0, 41_000.0)), (None, (0.0, 0.0))],
)
def test_points_and_columns(tmp_path: Path, write_format, origin, far_m: tuple[float, float]) -> None:
    source = write(tmp_path / "m", scattered(1, far_m=far_m), origin)
    path = write_format(source, tmp_path, Options())[0]
    found = read(path)
    right = expected(source, Projector.of(source, Options()))
    assert len(found["positions"]) == source.points == len(right)
    assert np.abs(found["positions"] + offset(path) - right).max() < 2e-5
    assert np.array_equal(found["intensity"][:, 0], column(source, "intensity"))
    assert np.array_equal(found["class"][:, 0], column(source, "class_"))


def test_ply_has_every_column(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(2), origin=None)
    found = read(write_ply(source, tmp_path, Options())[0])
    assert np.array_equal(found["count"][:, 0], column(source, "count"))
    assert np.array_equal(found["level"][:, 0], column(source, "level"))
    # Tiles number their sessions b, a; the map's header a, b.
    assert np.array_equal(found["session"][:, 0], 1 - column(source, "session"))
    assert np.abs(found["first_s"][:, 0] - column(source, "first_ns") / 1e9).max() < 1e-6
    assert np.abs(found["last_s"][:, 0] - column(source, "last_ns") / 1e9).max() < 1e-6
    assert np.abs(found["normals"] - column(source, "normal") / 127.0).max() < 0.02


def test_normals_turn_with_the_axes(tmp_path: Path) -> None:
    n = 300
    east = np.tile(np.array([[127, 0, 0]], np.int8), (n, 1))
    source = write(tmp_path / "m", scattered(3, n), normal=east)
    found = read(write_ply(source, tmp_path, Options())[0])["normals"]
    turn = MUNICH.grid_convergence_rad
    assert np.abs(found - [np.cos(turn), np.sin(turn), 0.0]).max() < 1e-4


def test_headers_say_where_it_is(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(4, 10))
    for write_format in (write_ply, write_pcd):
        path, beside = write_format(source, tmp_path, Options())
        head = path.read_bytes()[:900].decode("ascii", "ignore")
        assert "crs EPSG:32632" in head and "WGS84 ellipsoid" in head
        body = json.loads(beside.read_text())
        assert body["epsg"] == 32632 and 'PROJCRS["WGS 84 / UTM zone 32N"' in body["crs_wkt"]


def test_without_georeference_it_says_so(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(4, 10), origin=None)
    for write_format in (write_ply, write_pcd):
        path, beside = write_format(source, tmp_path, Options())
        assert b"crs none" in path.read_bytes()[:900]
        assert json.loads(beside.read_text())["crs_wkt"] is None


@pytest.mark.parametrize("write_format", [write_ply, write_pcd])
def test_one_point(tmp_path: Path, write_format) -> None:
    source = write(tmp_path / "m", np.array([[-0.5, -120.25, 3.0]]))
    path = write_format(source, tmp_path, Options())[0]
    assert (
        np.abs(
            read(path)["positions"] + offset(path) - expected(source, Projector.of(source, Options()))
        ).max()
        < 1e-5
    )


@pytest.mark.parametrize("write_format", [write_ply, write_pcd])
def test_removed_points_come_with_their_classes(tmp_path: Path, write_format) -> None:
    source = write(tmp_path / "m", scattered(5, 100))
    add_removed(tmp_path / "m", scattered(6, 30) % 50.0)
    (tmp_path / "without").mkdir()
    assert len(read(write_format(source, tmp_path / "without", Options())[0])["class"]) == 100
    found = read(write_format(source, tmp_path, Options(removed=True))[0])["class"][:, 0]
    assert len(found) == 130
    assert np.bincount(found[100:], minlength=7)[3:].tolist() == [10, 10, 0, 10]


@pytest.mark.parametrize("write_format", [write_ply, write_pcd])
def test_an_empty_tile_among_others(tmp_path: Path, write_format) -> None:
    source = write(tmp_path / "m", scattered(7, 400))
    tile = source.tile("0_0")
    tile.take(slice(0, 0)).write(tmp_path / "m/tiles/0_0.parquet")
    found = read(write_format(source, tmp_path, Options())[0])
    assert len(found["positions"]) == 400 - len(tile) > 0
