"""Ground against exact truth where it is hard: feet of things, canopies, kerbs, edges of embankments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from scanloom.stages.geometry.columns import EDGE_M, REACH_M, TALL_M, standing
from scanloom.stages.geometry.ground import FOOT_M, ground_mask
from scanloom.stages.geometry.se3 import F8, pose
from tests.worlds import GROUND_Z_M, BoxWorld, observe, street

TOLERANCE_M = 0.15
LOW_DEG, HIGH_DEG = -25.0, 15.0


def found_in(points: F8) -> NDArray[np.bool_]:
    x, y, z = np.ascontiguousarray(points.T, np.float32)
    usable = np.linalg.norm(points, axis=1) > 2.0
    return ground_mask(x, y, z, usable, np.eye(3), TOLERANCE_M)


def seen(
    world: BoxWorld, rows: int, noise_m: float = 0.01, seed: int = 0, place: tuple[float, float] = (0, 0)
) -> F8:
    """Points (n, 3) of one scan in axes of the world with the sensor in the origin."""
    T = pose(np.eye(3), [*place, 0.0])
    scan = observe(world, T, rng=np.random.default_rng(seed), rows=rows, columns=1024, noise_m=noise_m)
    return scan.points().astype(float)


def box(x: float, y: float, length: float, width: float, low: float, high: float) -> list[list[float]]:
    """A box by its middle, between two heights above the ground, m."""
    return [
        [x - length / 2, y - width / 2, GROUND_Z_M + low],
        [x + length / 2, y + width / 2, GROUND_Z_M + high],
    ]


@pytest.mark.parametrize("rows", [32, 64])
def test_feet_of_what_stands_on_the_ground_are_not_ground(rows: int) -> None:
    corners = [(x, y) for x in (-11.0, -7.5, 5.0, 8.0, 10.0) for y in (-6.0, 0.5, 6.0)]
    world = BoxWorld(np.array([box(x, y, 0.4, 0.5, 0.0, 1.7) for x, y in corners]))
    points = seen(world, rows)
    height = points[:, 2] - GROUND_Z_M
    person = np.zeros(len(points), bool)
    for x, y in corners:
        person |= (np.abs(points[:, 0] - x) < 0.24) & (np.abs(points[:, 1] - y) < 0.29)
    feet = person & (height > FOOT_M + 0.04) & (height < TOLERANCE_M)
    assert feet.sum() > 20
    ground = found_in(points)
    assert ground[feet].mean() < 0.05
    clear = ~person & (height < 0.05)
    assert 0.98 < ground[clear].mean() <= 1.0


def test_ground_under_a_roof_is_ground() -> None:
    roof = [box(10.0, 0.0, 12.0, 12.0, TALL_M + 0.2, TALL_M + 0.4)]
    points = seen(BoxWorld(np.array(roof)), 32)
    height = points[:, 2] - GROUND_Z_M
    below = (height < 0.1) & (np.abs(points[:, 0] - 10.0) < 6.0) & (np.abs(points[:, 1]) < 6.0)
    ground = found_in(points)
    assert below.sum() > 1000
    assert ground[below].mean() > 0.99
    assert not ground[height > 0.3].any()


@pytest.mark.parametrize("kerb_m", [0.08, 0.14, 0.2])
@pytest.mark.parametrize("rows", [16, 64])
def test_pavements_behind_kerbs_are_ground(kerb_m: float, rows: int) -> None:
    sides = [box(0.0, side * 9.0, 200.0, 10.0, -1.0, kerb_m) for side in (-1.0, 1.0)]
    points = seen(BoxWorld(np.array(sides)), rows)
    beside = np.abs(points[:, 1])
    ground = found_in(points)
    for low, high in ((0.0, 3.9), (4.5, 8.0), (8.0, 13.5)):  # road, near pavement, far pavement
        band = (beside > low) & (beside < high) & (np.hypot(points[:, 0], points[:, 1]) < 20.0)
        assert band.sum() > 100
        assert ground[band].mean() > 0.97


@dataclass(frozen=True)
class Embankment(BoxWorld):
    """A road 8 m wide whose sides fall by `depth_m` at once to level land."""

    depth_m: float = 3.0

    def ranges(self, origin: F8, direction: F8, far_m: float = 100.0) -> F8:
        with np.errstate(divide="ignore", invalid="ignore"):
            road = (GROUND_Z_M - origin[:, 2]) / direction[:, 2]
            land = (GROUND_Z_M - self.depth_m - origin[:, 2]) / direction[:, 2]
            on_road = (road > 0) & (np.abs(origin[:, 1] + road * direction[:, 1]) < 4.0)
            best = np.where(on_road, road, np.where(land > 0, land, np.inf))
        return np.where(best < far_m, best, np.inf)


@pytest.mark.parametrize("depth_m", [1.0, 3.0])
def test_land_below_an_embankment_is_ground(depth_m: float) -> None:
    points = seen(Embankment(np.zeros((0, 2, 3)), depth_m), 64)
    ground = found_in(points)
    road = np.abs(points[:, 2] - GROUND_Z_M) < 0.1
    land = ~road & (np.hypot(points[:, 0], points[:, 1]) < 25.0)
    assert land.sum() > 1000
    assert ground[road].mean() > 0.97
    assert ground[land].mean() > 0.9


def test_single_points_deep_below_the_ground_are_not_followed() -> None:
    """Mirrored by a wet road or by glass: what lies deeper is followed only where cells in a row agree."""
    points = seen(street(0), 32)
    rng = np.random.default_rng(1)
    ghosts = points[rng.choice(np.flatnonzero(points[:, 2] > 0.0), 60)] * [1.0, 1.0, -1.0] - [0.0, 0.0, 4.5]
    ground = found_in(np.vstack((points, ghosts)))
    assert ground[len(points) :].mean() < 0.1
    assert (ground[: len(points)] == found_in(points)).mean() > 0.995


def test_the_same_points_give_the_same_bytes() -> None:
    points = seen(street(3), 32)
    assert found_in(points).tobytes() == found_in(points.copy()).tobytes()


def test_columns_count_what_stands_within_an_edge_and_a_half() -> None:
    def under(gap_m: float, height_m: float) -> bool:
        x = np.array([5.125, 5.125 + gap_m], np.float32)  # the first lies in the middle of a column
        above = np.array([0.0, height_m], np.float32)
        flagged = standing(x, np.full(2, 0.125, np.float32), above, TOLERANCE_M)
        assert not flagged[1]
        return bool(flagged[0])

    assert under(0.0, TOLERANCE_M)
    assert not under(0.0, TOLERANCE_M - 0.01)
    assert under(0.0, TALL_M - 0.01)
    assert not under(0.0, TALL_M + 0.01)
    assert under(0.9 * EDGE_M, 1.0)
    assert not under(1.1 * EDGE_M, 1.0)


@pytest.mark.parametrize("at", [-REACH_M, REACH_M, 3 * REACH_M, -REACH_M + 0.01, REACH_M - 0.01, np.nan])
def test_columns_end_at_their_reach(at: float) -> None:
    x = np.full(2, at, np.float32)
    above = np.array([0.0, 1.0], np.float32)
    assert not standing(x, np.zeros(2, np.float32), above, TOLERANCE_M).any()
    assert not standing(np.zeros(2, np.float32), x, above, TOLERANCE_M).any()
