"""Figures of the map by worlds whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.metrics import METRICS, kind_of
from scanloom.schemas.scans import PointClass
from scanloom.stages.evaluation.crispness import map_figures, quantile
from scanloom.stages.evaluation.passes import Passes
from scanloom.stages.geometry.se3 import F8, pose
from tests.stages.evaluation.tiles import MANNER, map_values, parts_of
from tests.stages.mapping import START_NS, poses_of
from tests.tiles import tile_of

RNG = np.random.default_rng(11)


def plane(sigma_m: float, points: int = 60_000, side_m: float = 20.0) -> F8:
    return np.column_stack((RNG.uniform(0, side_m, (points, 2)), RNG.normal(0, sigma_m, points)))


@pytest.mark.parametrize("sigma_m", [0.01, 0.02, 0.04])
def test_the_entropy_of_a_noisy_plane_is_known_in_closed_form(sigma_m: float) -> None:
    """Methods 1.13: h = 1/2 ln((2 pi e)^3 r^4 s^2 / 16); few neighbours and the border of the plane cost a little."""
    found = map_values(tile_of(plane(sigma_m, 200_000)))
    for radius in (0.3, 0.5, 1.0):
        want = 0.5 * np.log((2 * np.pi * np.e) ** 3 * radius**4 * sigma_m**2 / 16)
        error = found[f"map.mme_r{radius}_nat"] - want
        thick = (sigma_m / radius) ** 2
        assert -0.05 - 0.1 * radius - 2 * thick < error < 3 * thick
        assert found[f"map.mme_r{radius}_share"] == 1.0


def test_the_plane_variance_of_a_noisy_plane_is_that_of_the_noise() -> None:
    for sigma_m in (0.01, 0.03):
        found = map_values(tile_of(plane(sigma_m)))
        assert found["map.mpv_r0.5_m2"] == pytest.approx(sigma_m**2, rel=0.05)
        assert found["map.plane_sigma_median_m"] == pytest.approx(sigma_m, rel=0.03)


@pytest.mark.parametrize("offset_m", [0.02, 0.05, 0.1, 0.2])
def test_a_vertical_offset_between_passes_raises_entropy_and_variance(offset_m: float) -> None:
    """Two sheets d apart have the variance s^2 + d^2 / 4; methods 1.13 measures 0.05, 0.26, 0.64, 1.17 nat likewise."""
    one, other = plane(0.03), plane(0.03)
    base = map_values(tile_of(np.concatenate((one, other))))
    apart = map_values(tile_of(np.concatenate((one, other + np.array([0, 0, offset_m])))))
    variance = 0.03**2 + offset_m**2 / 4
    rise = apart["map.mme_r0.5_nat"] - base["map.mme_r0.5_nat"]
    error = rise - 0.5 * np.log(variance / 0.03**2)
    assert (
        -0.05 - 0.4 * (offset_m / 0.5) ** 2 < error < 0.05
    )  # a ball cuts a smaller disc from the other sheet
    assert apart["map.mpv_r0.5_m2"] == pytest.approx(variance, rel=0.06)


def test_tiles_count_by_their_points_however_many_are_sampled() -> None:
    """A large crisp tile and a small blurred one, sampled alike."""
    large, small = tile_of(plane(0.01, 80_000)), tile_of(plane(0.05, 20_000, 10.0))
    parts = [map_values(tile)["map.mme_r0.5_nat"] for tile in (large, small)]
    both = map_values(large, small)["map.mme_r0.5_nat"]
    assert both == pytest.approx(0.8 * parts[0] + 0.2 * parts[1], abs=1e-5)


def test_density_of_ground_and_of_surfaces() -> None:
    x, y = np.meshgrid(np.arange(0.05, 20, 0.125), np.arange(0.05, 20, 0.125))
    grid = np.column_stack((x.ravel(), y.ravel(), RNG.normal(0, 0.005, x.size)))
    found = map_values(tile_of(grid, class_=int(PointClass.GROUND)))
    assert found["map.ground_density_median"] == found["map.ground_density_p10"] == 64
    strewn = map_values(tile_of(plane(0.005)))
    assert strewn["map.surface_density_median"] == pytest.approx(150, rel=0.03)
    assert strewn["map.surface_density_p10"] < 145 < 155 < strewn["map.surface_density_p90"]
    assert "map.ground_density_median" not in strewn


def test_the_tenth_of_the_ground_that_is_thin_is_seen() -> None:
    dense = RNG.uniform([0, 0, 0], [20, 16, 0.02], (16_000, 3))
    thin = RNG.uniform([0, 16, 0], [20, 20, 0.02], (400, 3))
    found = map_values(tile_of(np.concatenate((dense, thin)), class_=int(PointClass.GROUND)))
    assert 46 < found["map.ground_density_median"] < 52
    assert 3 <= found["map.ground_density_p10"] <= 6


def test_measured_points_are_counted() -> None:
    tile = tile_of(plane(0.01, 1000), count=np.full(1000, 7, np.int32))
    assert map_values(tile)["map.returns_per_point"] == 7.0


@pytest.mark.parametrize("points", [0, 1, 2, 5])
def test_nearly_empty_tiles_do_no_harm(points: int) -> None:
    found = map_values(tile_of(RNG.uniform(0, 3, (points, 3))))
    assert found["map.points"] == points
    assert found.get("map.wall_patches", 0) == 0
    assert not [name for name, value in found.items() if not np.isfinite(value) and "mme" not in name]


def test_what_one_tile_gives_does_not_depend_on_the_others() -> None:
    a, b = tile_of(plane(0.02, 5000)), tile_of(plane(0.04, 3000))
    alone, both = map_values(a), map_values(a, b)
    assert both["map.points"] == alone["map.points"] + 3000
    assert both["map.area_m2"] == alone["map.area_m2"] + map_values(b)["map.area_m2"]


@pytest.mark.parametrize("q", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_weighted_quantiles_are_those_of_the_values_repeated(q: float) -> None:
    values, weights = RNG.normal(size=300), RNG.integers(1, 6, 300)
    repeated = np.quantile(np.repeat(values, weights), q)
    assert quantile(values, weights, q) == pytest.approx(repeated, abs=0.1)


# --- passes ---


def drive(x: F8, y: F8, first: int = 0) -> object:
    """Ten scans a second at these places."""
    T = pose(np.tile(np.eye(3), (len(x), 1, 1)), np.column_stack((x, y, np.zeros(len(x)))))
    poses = poses_of(T)
    poses.stamp_ns[:] = START_NS + (first + np.arange(len(x))) * 100_000_000
    return poses


def met(tile_at: F8, first_s: F8, last_s: F8, poses: dict[str, object]) -> dict[str, float]:
    stamp = [START_NS + np.round(1e9 * np.asarray(s)).astype(np.int64) for s in (first_s, last_s)]
    return map_values(tile_of(tile_at, first_ns=stamp[0], last_ns=stamp[1]), poses=poses)


STRAIGHT = np.arange(0.0, 400.0)  # 10 m/s for 40 s, and the same way back


def test_a_street_driven_once_is_met_once_and_driven_twice_is_met_again() -> None:
    there = drive(STRAIGHT, 0 * STRAIGHT)
    again = drive(np.concatenate((STRAIGHT, STRAIGHT[::-1])), np.zeros(800))
    points = np.array([[10.2, 5.0, 0.0], [20.7, 5.0, 0.0], [30.3, -5.0, 0.0], [30.6, 8.0, 1.0]])
    once = met(points, np.zeros(4), np.array([7.0, 8.0, 9.0, 9.0]), {"a": there})
    assert once["map.overlap_share"] == once["map.overlap_area_share"] == 0.0
    twice = met(points, np.zeros(4), np.array([78.0, 78.0, 9.0, 9.0]), {"a": again})
    assert twice["map.overlap_share"] == 0.5
    assert twice["map.overlap_area_share"] == pytest.approx(2 / 4)
    assert "map.overlap_sessions_share" not in twice


def test_standing_still_is_no_second_pass() -> None:
    x = np.concatenate((np.linspace(0, 50, 50), np.full(6000, 50.0), np.linspace(50, 100, 50)))
    found = met(np.array([[40.0, 5.0, 0.0]]), np.zeros(1), np.array([605.0]), {"a": drive(x, 0 * x)})
    assert found["map.overlap_share"] == 0.0


@pytest.mark.parametrize(("way_m", "again"), [(39.0, 0.0), (41.0, 1.0)])
def test_the_way_away_and_back_must_be_twice_the_distances_and_twenty_metres(
    way_m: float, again: float
) -> None:
    x = np.concatenate((np.linspace(0, way_m / 2, 100), np.linspace(way_m / 2, 0, 100)))
    found = met(np.array([[0.0, 5.0, 0.0]]), np.zeros(1), np.array([19.9]), {"a": drive(x, 0 * x)})
    assert found["map.overlap_share"] == again  # 5 m then and 5 m now: twice ten and twenty


def test_points_that_two_sessions_met_overlap() -> None:
    poses = {"a": drive(STRAIGHT, 0 * STRAIGHT), "b": drive(STRAIGHT, 0 * STRAIGHT + 3, first=9000)}
    points = np.array([[10.0, 5.0, 0.0], [20.0, 5.0, 0.0], [30.0, 5.0, 0.0], [40.0, 5.0, 0.0]])
    found = met(points, np.array([0.0, 0, 0, 901]), np.array([3.0, 902, 4, 905]), poses)
    assert found["map.overlap_share"] == found["map.overlap_sessions_share"] == 0.25


def test_sessions_at_the_same_time_cannot_be_told_apart() -> None:
    poses = {"a": drive(STRAIGHT, 0 * STRAIGHT), "b": drive(STRAIGHT, 0 * STRAIGHT, first=399)}
    assert not Passes(poses).known  # type: ignore[arg-type]
    assert "map.overlap_share" not in met(np.zeros((1, 3)), np.zeros(1), np.ones(1), poses)
    poses["b"] = drive(STRAIGHT, 0 * STRAIGHT, first=400)
    assert Passes(poses).known  # type: ignore[arg-type]


# --- the list of metrics ---


def test_every_figure_of_the_map_is_listed_and_says_how_it_was_computed() -> None:
    points = np.concatenate((plane(0.02, 8000), RNG.uniform([5, 5, 0], [15, 5.02, 4], (8000, 3))))
    tile = tile_of(points, class_=int(PointClass.GROUND))
    figures = list(map_figures(parts_of(tile), None, {"a": drive(STRAIGHT, 0 * STRAIGHT)}, MANNER))  # type: ignore[dict-item]
    assert len(figures) > 20
    for figure in figures:
        assert kind_of(figure.name) is not None, figure.name
        assert figure.method
        counted = figure.name in ("map.tiles", "map.points", "map.area_m2", "map.wall_patches")
        assert counted or (figure.samples is not None and f"{figure.samples} samples" in figure.how)


def test_no_name_is_listed_twice_and_none_hides_another() -> None:
    for kind in METRICS:
        assert kind_of(kind.name.replace("*", "1")) is kind or kind.name.startswith("clean.*"), kind.name
        assert kind.doc and not (kind.better == "" and (kind.absolute or kind.relative))
