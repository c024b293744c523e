"""What the benchmark of the extension says of cars and surfaces whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.parking import Bay, bays, gone_scores, inside
from benchmarks.surfaces import plane_distances
from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import Piece
from scanloom.stages.simulate.town import Thing

LEFT = Thing("car", np.array([10.0, 3.0, 0.8]), 0.0, np.array([4.0, 1.8, 1.5]))
AGAIN = Thing("car", np.array([20.0, 3.0, 0.8]), 0.0, np.array([4.0, 1.8, 1.5]))
FAR = Thing("car", np.array([10.0, 60.0, 0.8]), 0.0, np.array([4.0, 1.8, 1.5]))
PATH = np.column_stack((np.arange(0.0, 40.0), np.zeros((40, 2))))


def points_in(car: Thing, count: int = 30) -> np.ndarray:
    return np.asarray(car.centre + np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * car.size_m)


def test_a_turned_car_has_a_turned_box() -> None:
    turned = Thing("car", np.zeros(3), np.pi / 2, np.array([4.0, 1.8, 1.5]))
    points = np.array([[0.0, 2.2, 0.0], [0.0, 2.4, 0.0], [1.1, 0.0, 0.0], [1.3, 0.0, 0.0]])
    assert inside(turned, points).tolist() == [True, False, True, False]


def test_found_missed_and_false_objects_are_counted() -> None:
    parked = [Bay(LEFT, False), Bay(AGAIN, True), Bay(FAR, False)]
    asked = np.concatenate([points_in(car) for car in (LEFT, AGAIN, FAR)])
    points = np.concatenate((points_in(LEFT), points_in(AGAIN), np.full((12, 3), 5.0)))
    number = np.repeat(np.arange(3, dtype=np.int32), (30, 30, 12))
    scores = gone_scores(parked, points, number, asked, PATH)
    assert (scores.left, scores.found, scores.objects, scores.true) == (1, 1, 2, 1)
    assert scores.true_points == pytest.approx(60 / 72)
    nothing = gone_scores(parked, np.empty((0, 3)), np.empty(0, np.int32), asked, PATH)
    assert (nothing.left, nothing.found, nothing.objects) == (1, 0, 0)


@pytest.mark.parametrize(("share", "found"), [(9, 0), (10, 1)])
def test_a_third_of_a_car_must_be_reported(share: int, found: int) -> None:
    asked = points_in(LEFT)
    scores = gone_scores([Bay(LEFT, False)], asked[:share], np.zeros(share, np.int32), asked, PATH)
    assert scores.found == found


def test_the_town_knows_which_cars_leave() -> None:
    first = bays()
    assert len(first) == 36
    assert 10 <= sum(not bay.taken_again for bay in first) <= 25
    assert all(bay.taken_again for bay in bays(second_day=0))


def _floor(height_m: float, seed: int) -> Piece:
    """A floor of 10 m with a centimetre of noise, a point per decimetre."""
    rng = np.random.default_rng(seed)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 10, 0.1), np.arange(0, 10, 0.1)))
    n = len(x)
    return Piece(
        voxel=np.arange(n), count=np.ones(n, np.int32), sum_x_m=x, sum_y_m=y,
        sum_z_m=height_m + rng.normal(0, 0.01, n), sum_intensity=np.zeros(n), ground_count=np.zeros(n, np.int32),
        scan_count=np.ones(n, np.int32), first_ns=np.zeros(n, np.int64), last_ns=np.zeros(n, np.int64),
        view=np.tile(np.int8([0, 0, 127]), (n, 1)), frame="map", georeference=None, voxel_size_m=0.1, tile_size_m=50.0,
    )  # fmt: skip


@pytest.mark.parametrize("offset_m", [0.0, 0.05])
def test_distance_between_floors_is_what_lies_between_them(offset_m: float) -> None:
    pieces = Parts(
        [
            ((("chunk", "0"), ("session", name), ("tile", "0_0")), _floor(height, seed))
            for seed, (name, height) in enumerate((("old", 0.0), ("new", offset_m)))
        ]
    )
    d = np.abs(plane_distances(pieces, "old", "new"))
    assert len(d) > 1000
    expected = offset_m if offset_m else 0.0067  # the median of 1 cm of noise
    assert np.median(d) == pytest.approx(expected, abs=0.003)
