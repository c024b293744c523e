"""GeoTIFFs of a tilted plane, read by rasterio (GDAL)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.frames import Georeference
from scanloom.schemas.scans import PointClass
from scanloom.stages.exports.dem import write_dem
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.orthophoto import write_orthophoto
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import georeference, projected_to_world, world_to_projected
from tests.delivered import cut, write_map
from tests.stages.exports.tracks import CAPE_TOWN, MUNICH, delivered, plane

rasterio = pytest.importorskip("rasterio")
SLOPE = (0.5, -0.3)
CELL = 0.25


def clear_of_edges(points: np.ndarray, origin: Georeference, cell: float = CELL) -> np.ndarray:
    """Points (n, 3) as tiles keep them, without those so near an edge of a cell that rounding decides."""
    kept = points.astype(np.float32).astype(float)
    across = np.abs((world_to_projected(origin, kept)[:, :2] / cell + 0.5) % 1.0 - 0.5) * cell
    return kept[(across > 1e-3).all(axis=1)]


def histogram(raster, projected: np.ndarray) -> np.ndarray:
    """How many points fall into each cell, counted by numpy."""
    left, bottom, right, top = raster.bounds
    columns, rows = (
        np.linspace(a, b, n + 1) for a, b, n in ((left, right, raster.width), (bottom, top, raster.height))
    )
    counts = np.histogram2d(projected[:, 1], projected[:, 0], bins=(rows, columns))[0]
    return counts[::-1]


def surface(raster, origin: Georeference, slope: tuple[float, float] = SLOPE) -> np.ndarray:
    """Ellipsoidal height of the plane in the middle of every cell."""
    columns, rows = np.meshgrid(np.arange(raster.width), np.arange(raster.height))
    x, y = (
        np.asarray(v).ravel() for v in rasterio.transform.xy(raster.transform, rows.ravel(), columns.ravel())
    )
    local = projected_to_world(origin, np.column_stack((x, y, np.full(len(x), origin.height_m))))
    local[:, 2] = slope[0] * local[:, 0] + slope[1] * local[:, 1]
    return world_to_projected(origin, local)[:, 2].reshape(raster.height, raster.width)


@pytest.mark.parametrize("origin", [MUNICH, CAPE_TOWN], ids=["north", "south"])
def test_heights_of_a_plane(tmp_path: Path, origin: Georeference) -> None:
    points = clear_of_edges(plane(60_000, slope=SLOPE), origin)
    source = delivered(tmp_path / "m", origin, {}, points)
    assert {name.split("_")[0] for name in source.tile_names} == {"-1", "0"}
    paths = write_dem(source, tmp_path, Options())
    assert [path.name for path in paths] == ["dem.tif", "dem_lowest.tif", "dem_count.tif"]
    projected = world_to_projected(origin, points)
    with rasterio.open(paths[0]) as mean, rasterio.open(paths[1]) as lowest, rasterio.open(paths[2]) as count:
        for raster in (mean, lowest, count):
            assert raster.crs.to_epsg() == origin.epsg
            assert raster.res == (CELL, CELL)
            left, bottom, right, top = raster.bounds
            low, high = projected[:, :2].min(axis=0), projected[:, :2].max(axis=0)
            assert 0.0 <= low[0] - left < CELL and 0.0 <= low[1] - bottom < CELL
            assert 0.0 < right - high[0] <= CELL and 0.0 < top - high[1] <= CELL
            assert left / CELL == round(left / CELL) and top / CELL == round(top / CELL)
        counts = count.read(1)
        np.testing.assert_array_equal(counts, histogram(count, projected))
        wrong = (mean.read(1) - surface(mean, origin))[counts > 0]
        # A raster shifted by half a cell would be wrong by 0.0625 and 0.0375 m; points are anywhere in their cells.
        assert abs(wrong.mean()) < 0.002
        assert 0.01 < wrong.std() < 0.08
        assert np.abs(wrong).max() < (SLOPE[0] - SLOPE[1]) * CELL
        assert (lowest.read(1) <= mean.read(1))[counts > 0].all()
        assert "ellipsoid" in mean.tags()["HEIGHTS"]


def test_lowest_is_the_lowest(tmp_path: Path) -> None:
    points = clear_of_edges(plane(20_000, size_m=10.0, slope=SLOPE), MUNICH)
    _, lowest, _ = write_dem(delivered(tmp_path / "m", MUNICH, {}, points), tmp_path, Options(fill_cells=0))
    projected = world_to_projected(MUNICH, points)
    with rasterio.open(lowest) as raster:
        heights = raster.read(1)
        for row, column in [(5, 7), (20, 20), (33, 11)]:
            left, top = raster.xy(row, column, offset="ul")
            inside = (np.abs(projected[:, :2] - [left + CELL / 2, top - CELL / 2]) < CELL / 2).all(axis=1)
            assert heights[row, column] == pytest.approx(projected[inside, 2].min(), abs=1e-4)


def test_tiles_leave_no_seam(tmp_path: Path) -> None:
    """The same points in tiles of 50 and 11 m give the same rasters: nobody sees where a tile ended."""
    points = clear_of_edges(plane(60_000, slope=SLOPE), MUNICH)
    counts, means = [], []
    for size in (50.0, 11.0):
        folder = tmp_path / f"{size:g}"
        fields = MUNICH.model_dump()
        write_map(folder, cut(points, tile_size_m=size, class_=int(PointClass.GROUND), georeference=fields))
        mean, _, count = write_dem(MapSource.open(folder), folder, Options())
        counts.append(rasterio.open(count).read(1))
        means.append(rasterio.open(mean).read(1))
    np.testing.assert_array_equal(counts[1], counts[0])
    np.testing.assert_allclose(means[1], means[0], rtol=0.0, atol=2e-4)


def test_holes_are_filled_as_far_as_stated(tmp_path: Path) -> None:
    points = plane(60_000, size_m=40.0, slope=SLOPE)
    small = np.hypot(*(points[:, :2] - [5.0, 5.0]).T) < 0.6
    large = np.hypot(*(points[:, :2] + [9.0, 9.0]).T) < 6.0
    source = delivered(tmp_path / "m", MUNICH, {}, points[~small & ~large])
    mean, _, count = write_dem(source, tmp_path, Options())
    in_small, in_large = world_to_projected(MUNICH, [[5.0, 5.0, 1.0], [-9.0, -9.0, 0.0]])
    with rasterio.open(mean) as raster, rasterio.open(count) as counts:
        (filled,) = raster.sample([in_small[:2]])
        (number,) = counts.sample([in_small[:2]])
        assert number == 0
        assert filled == pytest.approx(in_small[2], abs=0.2)
        (unseen,) = raster.sample([in_large[:2]])
        assert unseen == raster.nodata
    bare, _, _ = write_dem(source, tmp_path, Options(fill_cells=0))
    with rasterio.open(bare) as raster:
        (nothing,) = raster.sample([in_small[:2]])
        assert nothing == raster.nodata


def test_files_are_cloud_optimized(tmp_path: Path) -> None:
    points = plane(20_000, size_m=140.0)
    for path in write_dem(delivered(tmp_path / "m", MUNICH, {}, points), tmp_path, Options()):
        with rasterio.open(path) as raster:
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert raster.compression.value == "DEFLATE"
            assert raster.block_shapes == [(512, 512)]
            assert raster.overviews(1) == [2]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "dem.tif",
        "dem_count.tif",
        "dem_lowest.tif",
        "m",
    ]


def test_only_ground_makes_heights(tmp_path: Path) -> None:
    source = delivered(tmp_path / "m", MUNICH, {}, plane(1000), class_=int(PointClass.STATIC))
    with pytest.raises(InvalidInput, match="no ground points"):
        write_dem(source, tmp_path, Options())
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


def roofed() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A road, intensity 10 + x, and a roof over its eastern half, intensity 200, walls between them of 90."""
    road, roof = plane(60_000, slope=(0.0, 0.0)), plane(60_000, slope=(0.0, 0.0), seed=1)
    roof = roof[roof[:, 0] > 0.0] + [0.0, 0.0, 5.0]
    wall = roof - [0.0, 0.0, 1.0]
    points = np.vstack((road, roof, wall))
    intensity = np.concatenate((50.0 + road[:, 0], np.full(len(roof), 200.0), np.full(len(wall), 90.0)))
    class_ = np.repeat([PointClass.GROUND, PointClass.STATIC], [len(road), 2 * len(roof)])
    return points, {"intensity": intensity.astype(np.float32), "class_": class_.astype(np.uint8)}


def test_intensity_from_above(tmp_path: Path) -> None:
    points, columns = roofed()
    source = delivered(tmp_path / "m", MUNICH, {}, points, columns=columns)
    top, ground = write_orthophoto(source, tmp_path, Options(cell_m=0.5))
    west, east, outside = world_to_projected(MUNICH, [[-10.0, 3.0, 0.0], [10.0, 3.0, 0.0], [0.0, 40.0, 0.0]])
    with rasterio.open(top) as above, rasterio.open(ground) as road:
        assert above.dtypes == ("uint16",) and above.nodata == 0
        assert above.crs.to_epsg() == MUNICH.epsg
        assert above.bounds == road.bounds

        def value(raster, place: np.ndarray) -> float:
            (number,) = next(raster.sample([place[:2]]))
            return raster.offsets[0] + raster.scales[0] * number if number else np.nan

        assert value(above, west) == pytest.approx(40.0, abs=0.5)
        assert value(road, west) == pytest.approx(40.0, abs=0.5)
        assert value(above, east) == pytest.approx(200.0, abs=0.01)
        assert value(road, east) == pytest.approx(60.0, abs=0.5)
        assert above.read(1).max() == 65535 and road.read(1).max() < 65535
        assert not next(iter(above.sample([outside[:2]]))).any()


def painted(points: np.ndarray, seed: int = 7) -> dict[str, np.ndarray]:
    """Colours of points: red and blue mixed by chance on the west half, green in the east but for a strip nobody saw."""
    west = points[:, 0] < 0.0
    red = np.random.default_rng(seed).random(len(points)) < 0.25
    colour = np.where(west[:, None], np.where(red[:, None], (255, 0, 0), (0, 0, 255)), (0, 128, 0))
    views = np.where(np.abs(points[:, 0] - 10.0) < 2.0, 0, 3)
    colour[views == 0] = 0
    return {"colour": colour.astype(np.uint8), "views": views.astype(np.uint16)}


def test_colour_from_above(tmp_path: Path) -> None:
    points, columns = roofed()
    colours = painted(points)
    lower = points[:, 2] < points[:, 2].max() - 0.5
    under = lower & (points[:, 0] > 0.0)
    colours["colour"][under] = (255, 255, 255)
    source = delivered(tmp_path / "m", MUNICH, {}, points, columns=columns | colours)
    top, _, picture = write_orthophoto(source, tmp_path, Options(cell_m=1.0))
    assert picture.name == "colour_top.tif"
    with rasterio.open(picture) as above, rasterio.open(top) as intensity:
        assert above.dtypes == ("uint8",) * 4
        assert [interpretation.name for interpretation in above.colorinterp] == [
            "red",
            "green",
            "blue",
            "alpha",
        ]
        assert above.crs.to_epsg() == MUNICH.epsg and above.bounds == intensity.bounds
        assert above.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        places = [[-10.0, 3.0, 0.0], [5.0, 3.0, 0.0], [10.0, 3.0, 0.0], [0.0, 40.0, 0.0]]
        west, east, unseen, outside = above.sample(world_to_projected(MUNICH, places)[:, :2])
        whole = above.read()
    red, _, blue = (((west[:3] / 255.0 + 0.055) / 1.055) ** 2.4).tolist()
    assert 0.0 < red < 0.6 and red + blue == pytest.approx(1.0, abs=0.02)
    assert west[1] == 0 and west[3] == 255
    assert east.tolist() == [0, 128, 0, 255], "neither what is below nor what nobody saw"
    assert unseen.tolist() == outside.tolist() == [0, 0, 0, 0]
    half = whole[:, :, : whole.shape[2] // 2 - 2].reshape(4, -1)
    mean = (((half[0, half[3] > 0] / 255.0 + 0.055) / 1.055) ** 2.4).mean()
    assert mean == pytest.approx(0.25, abs=0.01), "light is averaged, not the numbers of a picture"


def test_a_map_without_colours_has_no_picture(tmp_path: Path) -> None:
    names = [
        p.name
        for p in write_orthophoto(delivered(tmp_path / "m", MUNICH, {}, plane(500)), tmp_path, Options())
    ]
    assert names == ["intensity_top.tif", "intensity_ground.tif"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "intensity_ground.tif",
        "intensity_top.tif",
        "m",
    ]


def test_intensity_of_nothing_but_zeros(tmp_path: Path) -> None:
    top, _ = write_orthophoto(delivered(tmp_path / "m", MUNICH, {}, plane(2000)), tmp_path, Options())
    with rasterio.open(top) as raster:
        numbers = raster.read(1)
        assert set(np.unique(numbers)) == {0, 1}
        assert raster.offsets[0] + raster.scales[0] * 1 == pytest.approx(0.0, abs=1e-12)


def test_a_map_without_georeference_keeps_its_axes(tmp_path: Path) -> None:
    points = plane(40_000, slope=SLOPE)
    mean, _, _ = write_dem(delivered(tmp_path / "m", None, {}, points), tmp_path, Options())
    with rasterio.open(mean) as raster:
        assert raster.crs is None
        assert raster.bounds.left == np.floor(points[:, 0].min() / CELL) * CELL
        (height,) = next(raster.sample([(10.0, -4.0)]))
        assert height == pytest.approx(0.5 * 10.0 + 0.3 * 4.0, abs=0.2)


def test_cells_keep_their_size_in_feet(tmp_path: Path) -> None:
    origin = georeference(40.7, -74.0, 10.0)
    source = delivered(tmp_path / "m", origin, {}, plane(5000, size_m=20.0))
    mean, _, _ = write_dem(source, tmp_path, Options(epsg=6539, cell_m=0.5))
    with rasterio.open(mean) as raster:
        assert raster.crs.to_epsg() == 6539
        assert raster.res[0] == pytest.approx(0.5 / 0.3048006096)
        assert (raster.bounds.right - raster.bounds.left) * 0.3048006096 == pytest.approx(20.3, abs=1.2)


def test_one_point(tmp_path: Path) -> None:
    source = delivered(tmp_path / "m", MUNICH, {}, np.array([[-3.3, 4.4, 1.5]]))
    mean, _, count = write_dem(source, tmp_path, Options())
    with rasterio.open(mean) as raster, rasterio.open(count) as counts:
        assert raster.shape == (1, 1) and counts.read(1).tolist() == [[1]]
        want = world_to_projected(MUNICH, [[-3.3, 4.4, 1.5]])[0]
        assert raster.read(1)[0, 0] == pytest.approx(want[2], abs=1e-4)
        assert 0.0 <= want[0] - raster.bounds.left < CELL and 0.0 <= want[1] - raster.bounds.bottom < CELL


def test_far_apart_places_leave_the_file_small(tmp_path: Path) -> None:
    near = plane(4000, size_m=20.0, slope=SLOPE)
    far = near + np.array([900.0, 700.0, 900.0 * SLOPE[0] + 700.0 * SLOPE[1]])
    source = delivered(tmp_path / "m", MUNICH, {}, np.vstack((near, far)))
    mean, _, count = write_dem(source, tmp_path, Options())
    with rasterio.open(mean) as raster, rasterio.open(count) as counts:
        assert raster.width > 3500 and raster.height > 2800
        assert counts.read(1).sum() == 8000
        assert mean.stat().st_size < 0.01 * 4 * raster.width * raster.height
        places = world_to_projected(MUNICH, [[0.5, 0.5, 0.1], [900.5, 700.5, 240.1], [450.0, 350.0, 0.0]])
        first, second, between = (float(v[0]) for v in raster.sample(places[:, :2]))
    assert first == pytest.approx(places[0, 2], abs=0.2)
    assert second == pytest.approx(places[1, 2], abs=0.2)
    assert between == -9999.0


@pytest.mark.parametrize("cell", [0.1, 0.3, 1.0])
def test_cells_of_any_size_count_the_same_points(tmp_path: Path, cell: float) -> None:
    points = clear_of_edges(plane(3000, size_m=20.0), CAPE_TOWN, cell)
    _, _, count = write_dem(delivered(tmp_path / "m", CAPE_TOWN, {}, points), tmp_path, Options(cell_m=cell))
    with rasterio.open(count) as raster:
        assert raster.res == pytest.approx((cell, cell))
        np.testing.assert_array_equal(
            raster.read(1), histogram(raster, world_to_projected(CAPE_TOWN, points))
        )
