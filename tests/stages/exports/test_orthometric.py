"""Heights above the geoid in trajectories, rasters and the catalogue, with a geoid that is made up."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.exports.dem import write_dem
from scanloom.stages.exports.geojson import write_geojson
from scanloom.stages.exports.geoparquet import write_geoparquet
from scanloom.stages.exports.gpx import write_gpx
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.stac import write_stac
from tests.stages.exports.geoid import UNDULATION_M, made_up_egm96
from tests.stages.exports.tracks import MUNICH, delivered, plane, poses_along, way

rasterio = pytest.importorskip("rasterio")
ABOVE_SEA = Options(heights="orthometric", cell_m=1.0)


@pytest.fixture
def source(tmp_path: Path) -> MapSource:
    flat = plane(3000, slope=(0.0, 0.0), size_m=20.0)
    return delivered(tmp_path / "m", MUNICH, {"a": poses_along(way(4), MUNICH)}, flat)


@pytest.fixture
def _geoid(tmp_path: Path) -> Iterator[None]:
    folder = tmp_path / "proj"
    folder.mkdir()
    with made_up_egm96(folder):
        yield


@pytest.mark.usefixtures("_geoid")
def test_gpx_counts_from_the_geoid_and_geojson_does_not(tmp_path: Path, source: MapSource) -> None:
    gpxpy = pytest.importorskip("gpxpy")
    gpx = gpxpy.parse(write_gpx(source, tmp_path, ABOVE_SEA)[0].read_text())
    assert "geoid" in gpx.description and "EGM96" in gpx.description
    elevations = np.array([p.elevation for p in gpx.tracks[0].segments[0].points])
    line = json.loads(write_geojson(source, tmp_path, ABOVE_SEA)[0].read_text())["features"][0]
    heights = np.array(line["geometry"]["coordinates"])[:, 2]
    np.testing.assert_allclose(heights - elevations, UNDULATION_M, rtol=0.0, atol=2e-4)
    assert heights[0] == pytest.approx(561.7, abs=1e-3)


@pytest.mark.usefixtures("_geoid")
def test_geoparquet_has_a_compound_system(tmp_path: Path, source: MapSource) -> None:
    path = write_geoparquet(source, tmp_path, ABOVE_SEA)[0]
    footer = pq.read_schema(path).metadata
    column = json.loads(footer[b"geo"])["columns"]["geometry"]
    assert column["crs"]["type"] == "CompoundCRS"
    assert [part["id"]["code"] for part in column["crs"]["components"]] == [MUNICH.epsg, 5773]
    assert column["bbox"][2] == pytest.approx(561.7 - UNDULATION_M, abs=1e-3)
    assert b"geoid" in footer[b"heights"]


@pytest.mark.usefixtures("_geoid")
def test_heights_of_the_ground(tmp_path: Path, source: MapSource) -> None:
    with rasterio.open(write_dem(source, tmp_path, ABOVE_SEA)[0]) as raster:
        heights = raster.read(1, masked=True)
        assert np.abs(heights - (560.0 - UNDULATION_M)).max() < 1e-3
        assert "EGM96" in raster.tags()["HEIGHTS"]
        wkt = raster.crs.to_wkt()
        assert wkt.startswith("COMPD_CS") and '"5773"' in wkt and f'"{MUNICH.epsg}"' in wkt


@pytest.mark.usefixtures("_geoid")
def test_the_catalogue_gives_the_whole_system(tmp_path: Path, source: MapSource) -> None:
    pytest.importorskip("pystac")
    item = json.loads(write_stac(source, tmp_path, ABOVE_SEA)[0].read_text())
    assert item["properties"]["proj:code"] is None
    assert item["properties"]["proj:projjson"]["type"] == "CompoundCRS"
    assert item["properties"]["proj:bbox"][2] == pytest.approx(560.0 - UNDULATION_M, abs=1e-3)
    assert item["bbox"][2] == pytest.approx(560.0, abs=1e-3), "GeoJSON counts from the ellipsoid"


@pytest.mark.parametrize("write", [write_gpx, write_geoparquet, write_dem])
def test_without_a_grid_nothing_is_guessed(tmp_path: Path, source: MapSource, write) -> None:
    with pytest.raises(UsageError, match="us_nga_egm96_15"):
        write(source, tmp_path, ABOVE_SEA)


@pytest.mark.parametrize("options", [ABOVE_SEA, Options(epsg=25832)])
@pytest.mark.parametrize("write", [write_geoparquet, write_dem])
def test_a_map_that_stands_nowhere_has_no_system(tmp_path: Path, options: Options, write) -> None:
    with pytest.raises(InvalidInput, match="has no georeference"):
        write(delivered(tmp_path / "n", None, {"a": poses_along(way(3), None)}), tmp_path, options)
