"""Colours in point clouds, as other programs read them; without cameras the files are what they were."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.copc import write_copc
from scanloom.stages.exports.las import write_laz
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.pcd import write_pcd
from scanloom.stages.exports.ply import write_ply
from scanloom.stages.exports.source import MapSource
from tests.stages.exports.clouds import add_removed, colours, column, expected, scattered, sorted_rows, write
from tests.stages.exports.test_ply_pcd import read

POINTS = 3000


@pytest.fixture
def source(tmp_path: Path) -> MapSource:
    return write(tmp_path / "m", scattered(5, POINTS), origin=None, **colours(5, POINTS))


def test_ply(source: MapSource, tmp_path: Path) -> None:
    found = read(write_ply(source, tmp_path, Options())[0])
    assert np.array_equal(found["colors"], column(source, "colour"))
    assert np.array_equal(found["views"][:, 0], column(source, "views"))
    assert np.array_equal(found["count"][:, 0], column(source, "count"))


def test_pcd(source: MapSource, tmp_path: Path) -> None:
    found = read(write_pcd(source, tmp_path, Options())[0])
    assert np.array_equal(found["colors"], column(source, "colour"))
    assert np.array_equal(found["intensity"][:, 0], column(source, "intensity"))


@pytest.mark.parametrize("write_format", [write_laz, write_copc])
def test_laz_and_copc(source: MapSource, tmp_path: Path, write_format) -> None:
    cloud = laspy.read(write_format(source, tmp_path, Options())[0])
    assert cloud.header.point_format.id == 7
    found = np.column_stack((np.asarray(cloud.xyz), cloud.red, cloud.green, cloud.blue, cloud["count"]))
    place = np.round(expected_of(source), 3)
    right = np.column_stack((place, column(source, "colour") * 257.0, column(source, "count")))
    assert np.abs(sorted_rows(found) - sorted_rows(right)).max() < 1e-6
    assert found[:, 3:6].max() > 65000 and (found[:, 3:6].sum(axis=1) == 0).sum() == POINTS // 3


def test_what_is_left_out_is_black(source: MapSource, tmp_path: Path) -> None:
    add_removed(source.folder, np.add(scattered(9, 40, 1.0), (25.0, 25.0, 0.0)), None)
    cloud = laspy.read(write_laz(source, tmp_path, Options(removed=True))[0])
    out = np.asarray(cloud.withheld, bool)
    assert out.sum() == 40 and not np.asarray(cloud.red)[out].any() and not np.asarray(cloud.blue)[out].any()


def test_without_cameras_there_is_no_colour(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(6, 500), origin=None)
    assert not source.coloured
    assert "colors" not in read(write_ply(source, tmp_path, Options())[0])
    assert "colors" not in read(write_pcd(source, tmp_path, Options())[0])
    assert laspy.read(write_laz(source, tmp_path, Options())[0]).header.point_format.id == 6


def test_one_coloured_point_is_enough(tmp_path: Path) -> None:
    colour, views = np.zeros((500, 3), np.uint8), np.zeros(500, np.uint16)
    colour[137], views[137] = (255, 1, 7), 1
    source = write(tmp_path / "m", scattered(6, 500), origin=None, colour=colour, views=views)
    assert source.coloured
    found = read(write_ply(source, tmp_path, Options())[0])["colors"]
    assert found[found.any(axis=1)].tolist() == [[255, 1, 7]]


def expected_of(source: MapSource) -> np.ndarray:
    return expected(source, Projector.of(source, Options()))
