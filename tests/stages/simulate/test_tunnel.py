"""The tunnel: as long as asked for, closed, with what a long one must have; and what lies beyond it moves along."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from scanloom.schemas.scans import PointClass
from scanloom.stages.simulate.sweeping import cast, scene_of
from scanloom.stages.simulate.terrain import TUNNEL_M, Plan, height, relief, road_distance
from scanloom.stages.simulate.town import Town, build_town
from scanloom.stages.simulate.tunnel import (
    BARE_M,
    NICHE_DEEP_M,
    STATION_M,
    TUNNEL_HALF_M,
    TUNNEL_TALL_M,
    stations,
    tunnel,
)

LONG_M = 401.0  # no multiple of the walls' steps


@pytest.fixture(scope="module")
def long_town() -> Town:
    return build_town(0, 0, LONG_M)


def triangles(plan: Plan) -> int:
    return sum(len(mesh.triangles) for mesh, _ in tunnel(plan))


def test_the_sample_town_is_the_one_without_the_setting() -> None:
    mesh, kind, instance = build_town(0, 0).triangles()
    same, same_kind, same_instance = build_town(0, 0, TUNNEL_M).triangles()
    digests = [
        hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest()
        for arrays in ((mesh.vertices, kind, instance), (same.vertices, same_kind, same_instance))
    ]
    assert digests[0] == digests[1]
    assert Plan().tunnel == (125.0, 197.0)
    assert (Plan().field_x, Plan().east, Plan().beyond_m) == (245.0, 350.0, 0.0)


def test_what_lies_beyond_moves_along(long_town: Town) -> None:
    short = build_town(0, 0)
    longer = LONG_M - TUNNEL_M
    assert long_town.path.length_m - short.path.length_m == pytest.approx(2 * longer, abs=0.1)
    plan = long_town.terrain.plan
    assert plan.field_x == pytest.approx(245.0 + longer)
    for x, y in ((plan.field_x, 70.0), (400.0, 0.0), (400.0, 150.0)):
        assert road_distance(plan, np.array(x), np.array(y))[0] < 1e-6
    assert road_distance(plan, np.array(245.0), np.array(70.0))[0] > 50
    assert float(height(plan, 60.0, 40.0)) == float(height(Plan(), 60.0, 40.0))


def test_it_is_closed_from_portal_to_portal(long_town: Town) -> None:
    scene = scene_of(long_town.triangles()[0])
    start, end = long_town.terrain.plan.tunnel
    x = np.arange(start + 0.7, end - 0.2, 0.9)
    floor = relief(x, np.zeros_like(x))
    for direction, most in (([0, 1, 0], TUNNEL_HALF_M + NICHE_DEEP_M), ([0, -1, 0], TUNNEL_HALF_M + NICHE_DEEP_M),
                            ([0, 0, 1], TUNNEL_TALL_M - 1.0)):  # fmt: skip
        rays = np.column_stack((x, 0 * x + 0.6, floor + 1.0, np.tile(direction, (len(x), 1)))).astype(
            np.float32
        )
        assert cast(scene, rays)["range"].max() < most + 0.7
    along = np.array(
        [[start - 20, -1.75, float(relief(np.array(start), np.array(0.0))) + 2.0, 1, 0, 0]], np.float32
    )
    assert cast(scene, along)["range"][0] > 25  # and one can drive in


def test_stations_are_where_they_must_be() -> None:
    plan = Plan(LONG_M)
    right, left = stations(plan, -TUNNEL_HALF_M), stations(plan, TUNNEL_HALF_M)
    middles = sorted((a + b) / 2 for a, b in right + left)
    gaps = np.diff([plan.tunnel[0], *middles, plan.tunnel[1]])
    assert len(right) == len(left) == 1
    assert gaps.max() <= STATION_M
    assert gaps.min() > STATION_M / 2


@pytest.mark.parametrize("length_m, bare", [(BARE_M, True), (BARE_M + 0.5, False)])
def test_a_short_one_is_bare(length_m: float, bare: bool) -> None:
    signs = 2 * int(np.ceil((length_m - 12.5) / 25.0))
    shorter = triangles(Plan(BARE_M - 0.5))
    extra = triangles(Plan(length_m)) - shorter
    assert (extra < 100) if bare else (extra >= 12 * signs > 0)


def test_its_hill_is_ground_and_the_rest_is_not() -> None:
    kinds = [kind for _, kind in tunnel(Plan(LONG_M))]
    assert kinds == [PointClass.STATIC, PointClass.GROUND]
