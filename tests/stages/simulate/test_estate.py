"""The estate deceives: its streets look alike and are not the same; revisits are true, in both directions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.estate import BLOCKS, CORNER_M, WEST_X, EstatePlan, build_estate
from scanloom.stages.simulate.motion import build_motion
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.sweeping import Lidar, cast, scene_of
from scanloom.stages.simulate.town import Town, build_town
from scanloom.stages.simulate.truths import true_objects

SEEDS = (0, 1, 2)
STEP_M = 1.0
LONE_M = 50.0
"""Places nearer than this along the way are no revisit."""
SEEN_M = (48.0226, 24.6635, 30.3843, 20.9657, 21.9468, 22.9018, 9.3984, 16.3065)
"""What eight rays met in the sample's town before there was an estate."""


@pytest.fixture(scope="module")
def estates() -> dict[int, Town]:
    return {seed: build_estate(seed, 0) for seed in SEEDS}


def driven(town: Town) -> tuple[F8, F8]:
    """Places (n, 3) every metre of one lap and headings (n,), rad."""
    s = np.arange(0.0, town.path.length_m - 20.0, STEP_M)
    return town.path.at(s), town.path.heading(s)


def revisits(town: Town, least_turn: float, most_turn: float, within_m: float = 4.0) -> F8:
    """Distances (n,) m, of those that are `within_m`, to the nearest earlier place passed at such an angle."""
    p, heading = driven(town)
    gap = np.linalg.norm(p[:, None, :2] - p[None, :, :2], axis=2)
    turn = np.abs(np.mod(heading[:, None] - heading[None] + np.pi, 2 * np.pi) - np.pi)
    earlier = np.subtract.outer(np.arange(len(p)), np.arange(len(p))) * STEP_M > LONE_M
    gap = np.where(earlier & (turn >= least_turn) & (turn <= most_turn), gap, np.inf).min(axis=1)
    found: F8 = gap[gap < within_m]
    return found


@pytest.mark.parametrize("seed", SEEDS)
def test_one_lap_comes_back_in_both_directions(estates: dict[int, Town], seed: int) -> None:
    town = estates[seed]
    assert 850 < town.path.length_m < 1050
    same, opposite = revisits(town, 0.0, 0.3), revisits(town, np.pi - 0.3, np.pi)
    assert 150 < len(same) * STEP_M < 400
    assert 150 < len(opposite) * STEP_M < 400
    assert np.median(same) < 0.6
    assert np.median(opposite) == pytest.approx(3.5, abs=0.1)


@pytest.mark.parametrize("seed", SEEDS)
def test_streets_that_look_alike_are_not_the_same(estates: dict[int, Town], seed: int) -> None:
    """The second street, driven like the first in the same direction, shows the same houses 40 to 60 m away."""
    town, plan = estates[seed], EstatePlan.of(seed)
    assert 40 < plan.apart_m < 60
    houses = np.array([thing.centre[:2] for thing in town.things if thing.what == "house"])
    cars = np.array([thing.centre[:2] for thing in town.things if thing.what == "car"])
    p, heading = driven(town)
    east = np.cos(heading) > 0.99
    between = east & (p[:, 0] > WEST_X + 15) & (p[:, 0] < plan.east_x - 15)
    first, second = (p[between & (np.abs(p[:, 1] - y) < 3)] for y in (0.0, plan.apart_m))
    assert len(first) > 40
    assert np.abs(first[:, 0, None] - second[None, :, 0]).min(axis=1).max() < 1.0
    alike = cKDTree(houses).query(houses[np.abs(houses[:, 1]) < 20] + np.array([0, plan.apart_m]))[0]
    assert alike.max() < 0.05
    here = cars[np.abs(cars[:, 1]) < 8]
    moved = cKDTree(cars).query(here + np.array([0, plan.apart_m]))[0] > 1.5
    assert 0.2 < moved.mean() < 0.8


@pytest.mark.parametrize("seed", SEEDS)
def test_the_last_part_of_the_first_street_repeats_itself(estates: dict[int, Town], seed: int) -> None:
    town, plan = estates[seed], EstatePlan.of(seed)
    assert 25 < plan.period_m < 28
    houses = np.array([thing.centre[:2] for thing in town.things if thing.what == "house"])
    start = plan.east_x + CORNER_M
    row = houses[(houses[:, 0] > start) & (houses[:, 0] < start + (BLOCKS - 1) * plan.period_m - 1)]
    assert cKDTree(houses).query(row + np.array([plan.period_m, 0]))[0].max() < 0.05


def test_seeds_build_other_estates_and_the_same_one_again(estates: dict[int, Town]) -> None:
    plans = {EstatePlan.of(seed) for seed in SEEDS}
    assert len(plans) == len(SEEDS)
    counts = {seed: sum(t.what == "house" for t in town.things) for seed, town in estates.items()}
    assert min(counts.values()) > 150
    first = estates[0].triangles()[0]
    again, other = build_estate(0, 0).triangles()[0], estates[1].triangles()[0]
    assert first.vertices.tobytes() == again.vertices.tobytes()
    assert first.vertices.shape != other.vertices.shape


def test_another_day_parks_other_cars_and_moves_no_house(estates: dict[int, Town]) -> None:
    today, tomorrow = estates[0].things, build_estate(0, 1).things
    houses = [[t.centre for t in day if t.what == "house"] for day in (today, tomorrow)]
    np.testing.assert_array_equal(*houses)
    cars = [np.array([t.centre for t in day if t.what == "car"]) for day in (today, tomorrow)]
    gone = cKDTree(cars[1]).query(cars[0])[0] > 2.0
    assert 0.2 < gone.mean() < 0.8


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_stands_in_the_way(estates: dict[int, Town], seed: int) -> None:
    town = estates[seed]
    p, heading = driven(town)
    ahead = np.column_stack((np.cos(heading), np.sin(heading), np.zeros(len(p))))
    aside = np.column_stack((-ahead[:, 1], ahead[:, 0], np.zeros(len(p))))
    starts = [p + left * aside + np.array([0, 0, 1.0]) for left in (-0.9, 0.0, 0.9)]
    rays = np.concatenate((np.concatenate(starts), np.tile(ahead, (3, 1))), axis=1).astype(np.float32)
    assert cast(scene_of(town.triangles()[0]), rays)["range"].min() > 1.0


def test_scans_see_ground_and_houses(estates: dict[int, Town]) -> None:
    settings = Settings(size="small", route="estate", start_m=40.0, duration_s=2.0, columns=128)
    motion = build_motion(settings, estates[0].path)
    sweeps = list(Lidar(settings, estates[0], motion, []).sweeps())
    assert len(sweeps) == 20
    for sweep in sweeps:
        share = [float((sweep.kind == kind).mean()) for kind in (PointClass.GROUND, PointClass.STATIC)]
        assert 0.1 < share[0] < 0.7
        assert 0.2 < share[1] < 0.8


def test_objects_are_where_their_triangles_are(estates: dict[int, Town]) -> None:
    town = estates[0]
    objects = true_objects(town.things)
    mesh, _, instance = town.triangles()
    for number, what in ((1, "house"), (len(objects), "car")):
        row = number - 1
        assert objects.what[row] == what
        assert objects.instance[row] == number
        corners = mesh.vertices[np.unique(mesh.triangles[instance == number])]
        c, s = np.cos(objects.yaw_rad[row]), np.sin(objects.yaw_rad[row])
        local = (corners[:, :2] - [objects.x_m[row], objects.y_m[row]]) @ np.array([[c, -s], [s, c]])
        for axis, size in enumerate((objects.length_m[row], objects.width_m[row])):
            assert np.ptp(local[:, axis]) == pytest.approx(size)
            assert local[:, axis].max() == pytest.approx(size / 2)
        assert corners[:, 2].max() == pytest.approx(objects.z_m[row] + objects.height_m[row] / 2)
    assert (
        1.4
        < objects.height_m[objects.what == "car"].min()
        < objects.height_m[objects.what == "car"].max()
        < 2
    )
    assert (objects.height_m[objects.what == "house"] > 6).all()


def test_the_town_is_the_one_it_was() -> None:
    """The default world, against numbers taken before there was another."""
    town = build_town(0, 0)
    mesh, _, instance = town.triangles()
    assert (len(mesh.triangles), instance.max()) == (380_894, 82)
    assert town.path.length_m == pytest.approx(1298.994340, abs=1e-5)
    T = build_motion(Settings(), town.path).poses(np.array([30.0]))[0] @ T_BASE["lidar"]
    angles = 0.1 + np.arange(8) * np.pi / 4
    rays = np.column_stack((np.tile(T[:3, 3], (8, 1)), np.cos(angles), np.sin(angles), np.full(8, -0.05)))
    seen = cast(scene_of(mesh), rays.astype(np.float32))["range"]
    np.testing.assert_allclose(seen, SEEN_M, atol=1e-3)
