"""Geodesy against independent formulae, at the edges where signs and zones go wrong."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.stages.geometry.geodesy import (
    between_worlds,
    geodetic_to_world,
    georeference,
    projected_to_world,
    utm_epsg,
    world_to_geodetic,
    world_to_projected,
)

PLACES = [
    (49.011, 8.4228, 112.8),
    (-33.86, 151.21, 20.0),
    (0.0, 0.0, 0.0),
    (69.6, 18.95, 400.0),
    (-54.8, -68.3, -10.0),
]


def ecef(lat_deg: float, lon_deg: float, h: float) -> np.ndarray:
    """Closed form of geodetic to Earth-centred coordinates."""
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    e2 = 6.69437999014e-3
    n = 6378137.0 / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.array(
        [
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (n * (1 - e2) + h) * np.sin(lat),
        ]
    )


@pytest.mark.parametrize(
    "lat, lon, epsg",
    [
        (49.0, 8.4, 32632), (49.0, 5.999999, 32631), (49.0, 6.0, 32632), (-33.9, 151.2, 32756), (0.0, 3.0, 32631),
        (-0.001, 3.0, 32731), (10.0, -180.0, 32601), (10.0, 179.9999, 32660), (10.0, 180.0, 32601), (10.0, 352.0, 32629),
        (60.4, 5.3, 32632), (78.2, 15.6, 32633), (78.2, 8.9, 32631), (78.2, 9.0, 32633), (64.0, 5.3, 32631),
    ],
)  # fmt: skip
def test_zone_of_a_place(lat: float, lon: float, epsg: int) -> None:
    assert utm_epsg(lat, lon) == epsg


@pytest.mark.parametrize("lat, lon", [(84.1, 0.0), (-80.5, 0.0), (float("nan"), 0.0), (10.0, 1000.0)])
def test_no_zone_is_an_error_with_a_reason(lat: float, lon: float) -> None:
    with pytest.raises(StageError, match="UTM"):
        utm_epsg(lat, lon)


@pytest.mark.parametrize("place", PLACES)
def test_local_frame_is_east_north_up(place: tuple[float, float, float]) -> None:
    lat, lon, h = place
    origin = georeference(*place)
    moved = np.array([[lat + 1e-3, lon, h], [lat, lon + 1e-3, h], [lat, lon, h + 10]])
    a, o = np.radians(lat), np.radians(lon)
    R = np.array(
        [
            [-np.sin(o), np.cos(o), 0],
            [-np.sin(a) * np.cos(o), -np.sin(a) * np.sin(o), np.cos(a)],
            [np.cos(a) * np.cos(o), np.cos(a) * np.sin(o), np.sin(a)],
        ]
    )
    expected = np.array([R @ (ecef(*p) - ecef(*place)) for p in moved])
    np.testing.assert_allclose(geodetic_to_world(origin, *moved.T), expected, atol=1e-5)


@pytest.mark.parametrize("place", PLACES)
def test_round_trips_at_ten_kilometres(place: tuple[float, float, float]) -> None:
    origin = georeference(*place)
    points = np.array([[0, 0, 0], [1e4, 0, 50], [0, -1e4, -20], [-7e3, 7e3, 300]], float)
    geodetic = world_to_geodetic(origin, points)
    np.testing.assert_allclose(geodetic_to_world(origin, *geodetic.T), points, atol=1e-3)
    np.testing.assert_allclose(
        projected_to_world(origin, world_to_projected(origin, points)), points, atol=1e-3
    )


@pytest.mark.parametrize("place", PLACES)
def test_linear_form_agrees_to_a_centimetre_per_kilometre(place: tuple[float, float, float]) -> None:
    origin = georeference(*place)
    points = np.array([[100, 0, 0], [0, 100, 0], [-70, 70, 0], [300, 400, 0]], float)
    g, k = origin.grid_convergence_rad, origin.point_scale
    R = np.array([[np.cos(g), -np.sin(g)], [np.sin(g), np.cos(g)]])
    linear = np.array([origin.easting_m, origin.northing_m]) + k * points[:, :2] @ R.T
    exact = world_to_projected(origin, points)[:, :2]
    error = np.linalg.norm(linear - exact, axis=1)
    assert np.all(error < 1e-5 * np.linalg.norm(points, axis=1) + 1e-3)


def test_convergence_is_positive_east_of_the_central_meridian_in_the_north() -> None:
    assert georeference(49.0, 10.5, 0.0).grid_convergence_rad == pytest.approx(
        np.arctan(np.tan(np.radians(1.5)) * np.sin(np.radians(49.0))), abs=1e-5
    )
    assert georeference(49.0, 7.5, 0.0).grid_convergence_rad < 0
    assert georeference(-33.0, 10.5, 0.0).grid_convergence_rad < 0


def test_a_chosen_projected_system_is_kept() -> None:
    assert georeference(49.0, 5.99, 0.0, epsg=32632).epsg == 32632


def test_one_world_in_another_is_where_its_points_are() -> None:
    here, there = georeference(49.0, 8.4, 110.0), georeference(49.02, 8.37, 240.0)
    points = np.random.default_rng(0).uniform(-500, 500, (20, 3))
    T = between_worlds(here, there)
    want = geodetic_to_world(here, *world_to_geodetic(there, points).T)
    assert np.abs(points @ T[:3, :3].T + T[:3, 3] - want).max() < 1e-6
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-9
    assert 100 < np.linalg.norm(T[:3, 3]) < 4000
    assert np.array_equal(between_worlds(here, here), np.eye(4))
