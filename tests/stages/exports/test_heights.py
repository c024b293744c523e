"""Clouds with heights above a geoid that is made up."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.copc import write_copc
from scanloom.stages.exports.las import write_laz
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.pcd import write_pcd
from scanloom.stages.exports.ply import write_ply
from tests.stages.exports.clouds import expected, scattered, write
from tests.stages.exports.geoid import UNDULATION_M, made_up_egm96

laspy = pytest.importorskip("laspy")
pytest.importorskip("rasterio")
ABOVE_SEA = Options(heights="orthometric")


@pytest.fixture(autouse=True)
def _geoid(tmp_path: Path) -> Iterator[None]:
    (tmp_path / "proj").mkdir()
    with made_up_egm96(tmp_path / "proj"):
        yield


@pytest.mark.parametrize("write_format", [write_laz, write_copc])
def test_las_has_a_compound_system_and_lower_heights(tmp_path: Path, write_format) -> None:
    source = write(tmp_path / "m", scattered(1))
    found = laspy.read(write_format(source, tmp_path, ABOVE_SEA)[0])
    plain = expected(source, Projector.of(source, Options()))
    assert found.xyz[:, 2].mean() == pytest.approx(plain[:, 2].mean() - UNDULATION_M, abs=1e-3)
    assert np.abs(found.header.mins - plain.min(axis=0) + [0.0, 0.0, UNDULATION_M]).max() < 0.0015
    crs = found.header.parse_crs()
    assert crs.is_compound and [part.to_epsg() for part in crs.sub_crs_list] == [32632, 5773]


@pytest.mark.parametrize("write_format", [write_ply, write_pcd])
def test_headers_name_the_geoid(tmp_path: Path, write_format) -> None:
    source = write(tmp_path / "m", scattered(2, 50))
    path, beside = write_format(source, tmp_path, ABOVE_SEA)
    assert b"above the geoid, EGM96 height (EPSG:5773)" in path.read_bytes()[:900]
    body = json.loads(beside.read_text())
    assert body["vertical_epsg"] == 5773 and body["crs_wkt"].startswith("COMPOUNDCRS")
