"""Walls: thick by their noise, double by their gap, and everything that only looks like it."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.se3 import F8
from tests.stages.evaluation.tiles import map_values
from tests.tiles import tile_of

RNG = np.random.default_rng(5)
N = 5000


def wall(off_m: float = 0.0, sigma_m: float = 0.015, points: int = N, turn_rad: float = 0.3) -> F8:
    """A sheet of 12 by 5 m, `off_m` in front of the first."""
    along, up = RNG.uniform(0, 12, points), RNG.uniform(0, 5, points)
    away = RNG.normal(off_m, sigma_m, points)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.column_stack((10 + c * along - s * away, 10 + s * along + c * away, up))


@pytest.mark.parametrize("sigma_m", [0.01, 0.02, 0.05, 0.1])
def test_a_single_wall_is_as_thick_as_its_noise(sigma_m: float) -> None:
    found = map_values(tile_of(wall(sigma_m=sigma_m)))
    assert found["map.wall_patches"] > 900
    assert found["map.wall_double_share"] == 0.0
    assert 0.9 < found["map.wall_thickness_median_m"] / (1.935 * sigma_m) < 1.02


@pytest.mark.parametrize("gap_m", [0.1, 0.15, 0.25, 0.38])
def test_two_passes_that_do_not_fit_make_double_walls(gap_m: float) -> None:
    found = map_values(tile_of(np.concatenate((wall(), wall(gap_m)))))
    assert found["map.wall_double_share"] > 0.9
    assert found["map.wall_double_gap_median_m"] == pytest.approx(gap_m, abs=0.01)
    assert gap_m < found["map.wall_thickness_median_m"] < gap_m + 0.06


@pytest.mark.parametrize("gap_m", [0.02, 0.45, 1.0])
def test_layers_too_near_or_too_far_apart_are_no_double_wall(gap_m: float) -> None:
    found = map_values(tile_of(np.concatenate((wall(), wall(gap_m)))))
    assert found["map.wall_patches"] > 500
    assert found["map.wall_double_share"] == 0.0


def test_the_share_is_that_of_the_walls_that_are_double() -> None:
    far = wall() + np.array([20.0, 0.0, 0.0])
    found = map_values(tile_of(np.concatenate((wall(), wall(0.2), far, far + 1e-4))))
    assert 0.4 < found["map.wall_double_share"] < 0.55


def test_a_wall_seen_from_both_sides_has_two_true_faces_and_one_seen_twice_from_one_side_has_not() -> None:
    front, back = wall(0.0), wall(0.2)
    normal = np.array([-np.sin(0.3), np.cos(0.3), 0.0])
    points = np.concatenate((front, back))

    def seen(front_sign: int, back_sign: int) -> dict[str, float]:
        signs = np.repeat([front_sign, back_sign], N)[:, None]
        return map_values(tile_of(points, normal=np.rint(127 * signs * normal).astype(np.int8)))

    apart = seen(-1, 1)
    assert apart["map.wall_double_share"] == 0.0
    assert apart["map.wall_two_sided_share"] > 0.9
    for signs in ((1, 1), (-1, -1), (1, -1)):  # the last: a panel whose sides have changed places
        assert seen(*signs)["map.wall_double_share"] > 0.9


def test_windows_set_back_in_a_wall_do_not_double_it() -> None:
    def split(off_m: float, glass: bool) -> F8:
        points = wall(off_m, turn_rad=0.0)
        pane = ((points[:, 0] % 2.5) > 1.2) & ((points[:, 2] % 2.5) > 1.0)
        return np.asarray(points[pane == glass])

    found = map_values(tile_of(np.concatenate((split(0.0, False), split(-0.2, True)))))
    assert found["map.wall_patches"] > 500
    assert found["map.wall_double_share"] < 0.02


@pytest.mark.parametrize("what", ["posts", "ledges", "a pipe and a ledge"])
def test_what_stands_out_from_a_wall_in_strips_does_not_double_it(what: str) -> None:
    before = wall(0.2)
    along, up = (before[:, 0] - 10) / np.cos(0.3), before[:, 2]
    strips = {
        "posts": (along % 1.5) < 0.2,
        "ledges": (up % 1.5) < 0.2,
        "a pipe and a ledge": ((along % 4.0) < 0.15) | ((up > 2.0) & (up < 2.2)),
    }
    found = map_values(tile_of(np.concatenate((wall(), before[strips[what]]))))
    assert found["map.wall_patches"] > 900
    assert found["map.wall_double_share"] < 0.05


def test_trunks_bushes_and_poles_are_no_double_walls() -> None:
    angle, up = RNG.uniform(0, 2 * np.pi, (2, 6000))
    trunk = np.column_stack((5 + 0.2 * np.cos(angle), 5 + 0.2 * np.sin(angle), 3 * up / np.pi))
    bush = RNG.normal([20, 20, 1.5], [0.8, 0.8, 0.6], (6000, 3))
    found = map_values(tile_of(np.concatenate((trunk, bush))))
    assert found.get("map.wall_double_share", 0.0) == 0.0


def test_ground_alone_has_no_walls() -> None:
    flat = np.column_stack((RNG.uniform(0, 20, (20_000, 2)), RNG.normal(0, 0.02, 20_000)))
    found = map_values(tile_of(flat))
    assert found["map.wall_patches"] == 0
    assert "map.wall_double_share" not in found
