"""Maps for Autoware: the grid of PCD files, its list, and coordinates by Autoware's own rule."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from scanloom.schemas.errors import UsageError
from scanloom.stages.exports.autoware import write_autoware
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.geometry.geodesy import world_to_geodetic
from tests.stages.exports.clouds import MUNICH, PUNTA_ARENAS, expected, scattered, sorted_rows, write
from tests.stages.exports.geoid import UNDULATION_M, made_up_egm96
from tests.stages.exports.test_coordinates import tmerc


def positions(path: Path) -> np.ndarray:
    import open3d as o3d

    return np.asarray(o3d.io.read_point_cloud(str(path)).points)


def everything(folder: Path) -> np.ndarray:
    return np.concatenate([positions(path) for path in sorted((folder / "pointcloud_map.pcd").iterdir())])


@pytest.mark.parametrize(("origin", "middle"), [(MUNICH, 9.0), (PUNTA_ARENAS, -69.0)])
def test_coordinates_follow_the_projector(tmp_path: Path, origin, middle: float) -> None:
    points = scattered(1, 200)
    source = write(tmp_path / "m", points, origin)
    write_autoware(source, tmp_path, Options())
    place = yaml.safe_load((tmp_path / "map_projector_info.yaml").read_text())
    assert place["projector_type"] == "LocalCartesianUTM" and place["vertical_datum"] == "WGS84"
    east0, north0 = tmerc(place["map_origin"]["latitude"], place["map_origin"]["longitude"], middle)
    right = []
    for latitude, longitude, height in world_to_geodetic(origin, points):
        east, north = tmerc(latitude, longitude, middle)
        right.append((east - east0, north - north0, height))
    found = everything(tmp_path)
    assert len(found) == 200
    assert np.abs(sorted_rows(np.round(found, 3)) - sorted_rows(np.round(right, 3))).max() < 0.0011


def test_every_file_lies_in_its_cell(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(2))
    paths = write_autoware(source, tmp_path, Options())
    listed = yaml.safe_load((tmp_path / "pointcloud_map_metadata.yaml").read_text())
    assert listed.pop("x_resolution") == 20.0 and listed.pop("y_resolution") == 20.0
    folder = tmp_path / "pointcloud_map.pcd"
    assert set(listed) == {path.name for path in folder.iterdir()} == {path.name for path in paths[2:]}
    for name, corner in listed.items():
        assert all(isinstance(c, int) for c in corner)
        inside = positions(folder / name)[:, :2] - corner
        assert len(inside) and np.all(inside >= 0.0) and np.all(inside < 20.0)
    assert len(everything(tmp_path)) == source.points


def test_without_georeference_it_is_local(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(3), origin=None)
    write_autoware(source, tmp_path, Options())
    assert yaml.safe_load((tmp_path / "map_projector_info.yaml").read_text()) == {"projector_type": "Local"}
    right = expected(source, Projector.of(source, Options())).astype(np.float32)
    assert np.array_equal(sorted_rows(everything(tmp_path).astype(np.float32)), sorted_rows(right))


def test_one_point(tmp_path: Path) -> None:
    source = write(tmp_path / "m", np.array([[-0.5, -120.25, 3.0]]))
    assert len(write_autoware(source, tmp_path, Options())) == 3


@pytest.mark.parametrize("options", [Options(epsg=25832), Options(epsg=32633)])
def test_another_system_is_refused(tmp_path: Path, options: Options) -> None:
    source = write(tmp_path / "m", scattered(4, 10))
    with pytest.raises(UsageError, match="UTM zone"):
        write_autoware(source, tmp_path, options)


def test_its_own_zone_may_be_named(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(4, 10))
    assert write_autoware(source, tmp_path, Options(epsg=32632))


def test_heights_above_a_geoid_it_does_not_know(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    source = write(tmp_path / "m", scattered(4, 10))
    with made_up_egm96(tmp_path), pytest.raises(UsageError, match="EGM2008"):
        write_autoware(source, tmp_path, Options(heights="orthometric"))
    assert UNDULATION_M
