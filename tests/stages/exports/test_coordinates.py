"""From the map's frame into coordinate systems: exact everywhere, and clear where it cannot be."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.exports.coordinates import TOLERANCE_M, Patch, Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.geometry.geodesy import world_to_geodetic, world_to_projected
from tests.stages.exports.clouds import MUNICH, PUNTA_ARENAS, scattered, write
from tests.tiles import tile_of


def tmerc(latitude_deg: float, longitude_deg: float, middle_deg: float) -> tuple[float, float]:
    """Transverse Mercator, scale 0.9996, by Krueger's series to the fourth order (Karney 2011, eq. 7 to 12, 35)."""
    f, a = 1 / 298.257223563, 6378137.0
    n = f / (2 - f)
    e = math.sqrt(f * (2 - f))
    radius = a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180, 13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140, 49561 * n**4 / 161280,
    )  # fmt: skip
    phi, lam = math.radians(latitude_deg), math.radians(longitude_deg - middle_deg)
    t = math.sinh(math.atanh(math.sin(phi)) - e * math.atanh(e * math.sin(phi)))
    xi, eta = math.atan2(t, math.cos(lam)), math.asinh(math.sin(lam) / math.hypot(t, math.cos(lam)))
    north = xi + sum(c * math.sin(2 * j * xi) * math.cosh(2 * j * eta) for j, c in enumerate(alpha, 1))
    east = eta + sum(c * math.cos(2 * j * xi) * math.sinh(2 * j * eta) for j, c in enumerate(alpha, 1))
    return 0.9996 * radius * east, 0.9996 * radius * north


def projector(origin=MUNICH, epsg: int | None = None) -> Projector:
    return Projector(origin, epsg or origin.epsg, None)


@pytest.mark.parametrize(("origin", "middle", "south"), [(MUNICH, 9.0, 0.0), (PUNTA_ARENAS, -69.0, 1e7)])
def test_utm_by_a_series_of_its_own(origin, middle: float, south: float) -> None:
    points = scattered(1, 50, reach_m=3000.0)
    found = projector(origin).project(points)
    for (latitude, longitude, height), (x, y, z) in zip(world_to_geodetic(origin, points), found):
        east, north = tmerc(latitude, longitude, middle)
        assert x == pytest.approx(5e5 + east, abs=1e-5)
        assert y == pytest.approx(south + north, abs=1e-5)
        assert z == pytest.approx(height, abs=1e-6)


def test_it_is_what_the_rest_of_the_program_says() -> None:
    points = scattered(2)
    assert np.abs(projector().project(points) - world_to_projected(MUNICH, points)).max() < 1e-6


@pytest.mark.parametrize("far_m", [(0.0, 0.0), (-20_000.0, 30_000.0)])
@pytest.mark.parametrize("origin", [MUNICH, PUNTA_ARENAS])
def test_a_tile_by_its_polynomial_is_exact(origin, far_m: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform((0, 0, -30), (50, 50, 90), (5000, 3))
    tile = tile_of(points, offset_m=(*far_m, 0.0), georeference=origin.model_dump())
    exact = projector(origin).project(
        np.column_stack((tile.x_m, tile.y_m, tile.z_m)).astype(float) + tile.offset_m
    )
    assert 0.0 < np.abs(projector(origin).tile(tile) - exact).max() < TOLERANCE_M


def test_where_a_polynomial_is_not_good_enough_proj_decides() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform((0, 0, 0), (1e5, 1e5, 1e3), (3000, 3))
    tile = tile_of(points, georeference=MUNICH.model_dump(), tile_size_m=1e5, voxel_size_m=100.0)
    local = np.column_stack((tile.x_m, tile.y_m, tile.z_m)).astype(float)
    assert Patch.fit(projector(), local.min(axis=0), local.max(axis=0)).residual_m > TOLERANCE_M
    assert np.array_equal(projector().tile(tile), projector().project(local))


def test_the_residual_is_no_smaller_than_the_error() -> None:
    low, high = np.array([0.0, 0.0, -100.0]), np.array([3000.0, 3000.0, 400.0])
    patch = Patch.fit(projector(), low, high)
    points = np.random.default_rng(5).uniform(low, high, (20_000, 3))
    worst = np.abs(patch(points) - projector().project(points)).max()
    assert 1e-7 < worst <= 1.2 * patch.residual_m


def test_another_system(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(6, 20))
    points = scattered(6, 20)
    found = Projector.of(source, Options(epsg=25832)).project(points)
    latitude, longitude, height = world_to_geodetic(MUNICH, points).T
    x, y = Transformer.from_crs(4258, 25832, always_xy=True).transform(longitude, latitude)
    assert np.abs(found - np.column_stack((x, y, height))).max() < 1e-6


@pytest.mark.parametrize("origin", [MUNICH, PUNTA_ARENAS])
def test_the_wkt_for_las_is_read_as_the_system_with_three_axes(origin) -> None:
    found = projector(origin)
    read = CRS.from_wkt(found.wkt)
    assert read == found.crs
    assert len(read.axis_info) == 3
    assert read.to_2d().to_epsg() == origin.epsg
    assert "WGS84 ellipsoid" in found.heights


def test_axes_turn_by_the_grid_convergence() -> None:
    turned = projector().axes((0.0, 0.0, 0.0))
    assert math.atan2(turned[1, 0], turned[0, 0]) == pytest.approx(MUNICH.grid_convergence_rad, abs=1e-6)
    assert np.abs(turned @ turned.T - np.eye(3)).max() < 1e-12


def test_without_georeference_coordinates_are_the_maps_own(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(7, 30), origin=None)
    found = Projector.of(source, Options())
    assert found.wkt == "" and found.crs is None and "map's own" in found.heights
    assert np.array_equal(found.project([[1.0, 2.0, 3.0]]), [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize("options", [Options(epsg=25832), Options(heights="orthometric")])
def test_a_system_for_a_map_without_georeference(tmp_path: Path, options: Options) -> None:
    source = write(tmp_path / "m", scattered(7, 30), origin=None)
    with pytest.raises(InvalidInput, match="no georeference"):
        Projector.of(source, options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (Options(epsg=4326), "no projected system"),
        (Options(epsg=4978), "no projected system"),
        (Options(epsg=5555), "no projected system"),
        (Options(epsg=199_999), "there is no EPSG:199999"),
        (Options(epsg=31468), "de_adv_BETA2007.tif"),
        (Options(epsg=2056), "no transformation of known accuracy"),
        (Options(heights="orthometric"), "us_nga_egm96_15.tif"),
        (Options(heights="orthometric", vertical_epsg=3855), "us_nga_egm08_25.tif"),
        (Options(heights="orthometric", vertical_epsg=25832), "no system of heights"),
        (Options(heights="orthometric", vertical_epsg=199_999), "there is no EPSG:199999"),
    ],
)
def test_what_cannot_be_is_said(tmp_path: Path, options: Options, words: str) -> None:
    source = write(tmp_path / "m", scattered(8, 20))
    with pytest.raises(UsageError, match=words):
        Projector.of(source, options)


def test_a_missing_grid_is_named_with_its_place(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(8, 20))
    with pytest.raises(UsageError) as caught:
        Projector.of(source, Options(heights="orthometric"))
    assert "/proj" in caught.value.next_step and "cdn.proj.org" in caught.value.next_step
