"""Heights above the geoid in trajectories, rasters and the catalogue, with a geoid that is made up."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.dem import write_dem
from scanloom.stages.exports.geojson import write_geojson
from scanloom.stages.exports.geoparquet import write_geoparquet
from scanloom.stages.exports.gpx import write_gpx
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.stac import write_stac
from scanloom.stages.geometry.geodesy import georeference
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


GRIDS = {5773: "us_nga_egm96_15.tif", 3855: "us_nga_egm08_25.tif", 7837: "de_bkg_gcg2016.tif"}
"""What PROJ itself looks for: EGM96, EGM2008, and the German heights."""


@pytest.mark.parametrize("write", [write_gpx, write_geoparquet, write_dem])
@pytest.mark.parametrize("epsg", GRIDS)
def test_without_a_grid_nothing_is_guessed(tmp_path: Path, source: MapSource, write, epsg: int) -> None:
    if any((Path(folder) / GRIDS[epsg]).exists() for folder in places_of_grids()):
        pytest.skip("the grid is installed here")
    with pytest.raises(UsageError, match=GRIDS[epsg]) as caught:
        write(source, tmp_path, ABOVE_SEA.model_copy(update={"vertical_epsg": epsg}))
    advice = caught.value.next_step
    assert f"pyproj sync --file {GRIDS[epsg]}" in advice and "--heights ellipsoidal" in advice
    assert pyproj.datadir.get_user_data_dir() in advice and "https://cdn.proj.org" in advice


def places_of_grids() -> list[str]:
    return [*pyproj.datadir.get_data_dir().split(":"), pyproj.datadir.get_user_data_dir()]


@pytest.mark.parametrize(("east_deg", "covered"), [(0.01, True), (-0.01, False), (-1.0, False)])
def test_at_the_edge_of_a_grid(tmp_path: Path, east_deg: float, covered: bool) -> None:
    """A grid whose westernmost posts stand at 11 degrees knows nothing further west."""
    (tmp_path / "proj").mkdir()
    here = georeference(48.13, 11.0 + east_deg, 560.0)
    near = delivered(tmp_path / "m", here, {"a": poses_along(way(4), here)}, plane(300, size_m=20.0))
    with made_up_egm96(tmp_path / "proj", west_deg=10.5, columns=20):
        if covered:
            assert Projector.of(near, ABOVE_SEA).project(np.zeros(3))[0, 2] == pytest.approx(
                560.0 - UNDULATION_M, abs=1e-3
            )
            assert write_gpx(near, tmp_path, ABOVE_SEA)
        else:
            with pytest.raises(UsageError, match="5773") as caught:
                write_gpx(near, tmp_path, ABOVE_SEA)
            assert "--heights ellipsoidal" in caught.value.next_step
    assert list(tmp_path.glob("*.gpx")) == ([tmp_path / "trajectory.gpx"] if covered else [])


def test_a_damaged_grid_is_no_grid(tmp_path: Path, source: MapSource) -> None:
    folder = tmp_path / "proj"
    folder.mkdir()
    with made_up_egm96(folder):
        grid = folder / "us_nga_egm96_15.tif"
        grid.write_bytes(grid.read_bytes()[:300])
        with pytest.raises(UsageError):
            write_gpx(source, tmp_path, ABOVE_SEA)


@pytest.mark.parametrize("options", [ABOVE_SEA, Options(epsg=25832)])
@pytest.mark.parametrize("write", [write_geoparquet, write_dem])
def test_a_map_that_stands_nowhere_has_no_system(tmp_path: Path, options: Options, write) -> None:
    with pytest.raises(InvalidInput, match="has no georeference"):
        write(delivered(tmp_path / "n", None, {"a": poses_along(way(3), None)}), tmp_path, options)
