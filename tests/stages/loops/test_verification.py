"""Matching of two submaps and what is believed of it: true pairs from far-off priors, and everything that only looks alike."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_log, so3_exp, transform
from scanloom.stages.geometry.voxels import downsample
from scanloom.stages.loops.candidates import Candidate
from scanloom.stages.loops.matching import prior_of
from scanloom.stages.loops.submaps import Submap, _levelled
from scanloom.stages.loops.verification import Drift, Verdict, VerificationSettings, verify
from tests.stages.loops.worlds import block, labels_of, polyline, scans_of
from tests.worlds import GROUND_Z_M, BoxWorld

DRIFT = Drift(1e5)
FAR_OFF = pose(so3_exp(np.radians([2.0, -3.0, 14.0])), np.array([4.0, -5.0, 2.0]))
"""A prior's error: more than one sigma of the highest level in every direction."""


def submap(world: BoxWorld, T: F8, seed: int, labelled: bool = True, ground_z: float = GROUND_Z_M) -> Submap:
    """What scans along a path (n, 4, 4) saw, around the middle one."""
    scans = scans_of(world, T, seed=seed)
    middle = len(T) // 2
    here = inverse(T[middle])
    points = np.concatenate([transform(here @ Tk, s.points()) for Tk, s in zip(T, scans, strict=True)])
    ground = np.concatenate([label.class_ == 1 for label in labels_of(scans, T, ground_z)]) & labelled
    near = np.flatnonzero(np.linalg.norm(points, axis=1) < 50)
    kept = near[downsample(points[near], 0.3)]
    return _levelled(points[kept], ground[kept], scans[middle].points().astype(float))


def judged(
    i: Submap, j: Submap, predicted: F8 | None, settings: VerificationSettings | None = None
) -> Verdict:
    c = Candidate(0, 0, 0, 1, float("nan"), float("nan"), predicted, 0.0)
    return verify(settings or VerificationSettings(), c, DRIFT, i, j)


def off(T: F8, true: F8) -> tuple[float, float]:
    xi = se3_log(inverse(true) @ T)
    return float(np.linalg.norm(xi[3:])), float(np.degrees(np.linalg.norm(xi[:3])))


SIDE = -30.0
SOUTH = polyline([(SIDE, 12), (SIDE, -12)], step_m=3.0)
NORTH = polyline([(SIDE + 3, -14), (SIDE + 3, 10)], step_m=3.0)
AGAIN = polyline([(SIDE + 0.5, 8), (SIDE + 0.5, -16)], step_m=3.0)


def between(a: F8, b: F8) -> F8:
    return inverse(a[len(a) // 2]) @ b[len(b) // 2]


@cache
def street(which: str, labelled: bool = True) -> Submap:
    paths = {"south": SOUTH, "north": NORTH, "again": AGAIN}
    return submap(block(1), paths[which], seed=len(which), labelled=labelled)


@pytest.mark.parametrize("known", [True, False])
def test_the_opposite_direction_with_a_poor_prior_and_with_none(known: bool) -> None:
    true = between(SOUTH, NORTH)
    v = judged(street("south"), street("north"), true @ FAR_OFF if known else None)
    assert v.reason == ""
    shift, turn = off(v.T_i_j, true)
    assert shift < 0.1
    assert turn < 0.5
    assert 0 <= v.rival < 0.5
    assert 0 < v.e1_m < 0.05
    assert v.seen_through < 0.07
    sigma = np.sqrt(np.diag(v.covariance))
    assert np.all(sigma[3:] >= 0.05)
    assert np.all(sigma[:3] >= np.radians(0.2))


def test_without_labels_of_ground_the_pose_is_still_right() -> None:
    true = between(SOUTH, AGAIN)
    v = judged(street("south", False), street("again", False), true @ FAR_OFF)
    shift, turn = off(v.T_i_j, true)
    assert shift < 0.1
    assert turn < 0.5


def test_the_same_twice() -> None:
    one, two = (judged(street("south"), street("again"), between(SOUTH, AGAIN) @ FAR_OFF) for _ in range(2))
    for field in dataclasses.fields(Verdict):
        assert np.array_equal(getattr(one, field.name), getattr(two, field.name))


def test_elsewhere_is_refused() -> None:
    elsewhere = submap(block(7), polyline([(12, -30), (-12, -30)], step_m=3.0), seed=2)
    for predicted in (None, np.eye(4), FAR_OFF):
        assert judged(street("south"), elsewhere, predicted).reason


def with_points(submap: Submap, points: F8) -> Submap:
    return dataclasses.replace(submap, points=points, ground=np.zeros(len(points), bool))


@pytest.mark.parametrize("count", [0, 1])
def test_nothing_or_a_single_point_is_refused(count: int) -> None:
    bare = with_points(street("south"), np.full((count, 3), 5.0))
    for i, j in ((bare, street("again")), (street("again"), bare), (bare, bare)):
        assert judged(i, j, np.eye(4)).reason == "nothing upright to compare"


def test_a_tunnel_is_refused() -> None:
    top = GROUND_Z_M + 5.0
    boxes = [[[-120, s * 5 - 0.5, GROUND_Z_M], [120, s * 5 + 0.5, top]] for s in (-1, 1)]
    world = BoxWorld(np.array([*boxes, [[-120, -5.5, top], [120, 5.5, top + 0.5]]], float))
    a, b = polyline([(-12, 0), (12, 0)], 3.0), polyline([(-9, 0.4), (15, 0.4)], 3.0)
    v = judged(submap(world, a, 1), submap(world, b, 2), between(a, b))
    assert any(word in v.reason for word in ("degenerate", "not distinct", "ambiguous"))


def test_row_houses_in_step_are_ambiguous() -> None:
    boxes = []
    for x in np.arange(-130, 130, 8.0):
        for side in (-1, 1):
            y = sorted((side * 9.0, side * 16.0))
            boxes.append([[x, y[0], GROUND_Z_M], [x + 5.0, y[1], 5.0]])
    a, b = polyline([(-12, 0), (12, 0)], 3.0), polyline([(-9, 0.4), (15, 0.4)], 3.0)
    world = BoxWorld(np.array(boxes))
    i, j = submap(world, a, 1), submap(world, b, 2)
    for error in (0.0, 4.0, 8.0):
        v = judged(i, j, pose(np.eye(3), [error, 0, 0]) @ between(a, b))
        assert v.reason
        assert v.rival > 0.7 or "distinct" in v.reason


@cache
def decks() -> tuple[Submap, Submap, F8]:
    """A road between houses, the deck over it, and the pose of the one in the other."""
    rng = np.random.default_rng(4)
    top = GROUND_Z_M + 6.0
    boxes = [[[-60, -6, top - 0.5], [60, 6, top]]]
    for side in (-1, 1):
        boxes += [[[-60, side * 6 - 0.15, top], [60, side * 6 + 0.15, top + 0.9]]]
        for x in np.arange(-55, 60, 12.0):
            boxes.append([[x, side * 5.5 - 0.4, GROUND_Z_M], [x + 0.8, side * 5.5 + 0.4, top]])
            y = sorted((side * 14.0, side * (14 + rng.uniform(4, 9))))
            boxes.append([[x, y[0], GROUND_Z_M], [x + rng.uniform(5, 10), y[1], rng.uniform(9, 14)]])
    world = BoxWorld(np.array(boxes))
    low, high = polyline([(-12, 0), (12, 0)], 3.0), polyline([(-12, 0.5), (12, 0.5)], 3.0, z=6.0)
    i, j = submap(world, low, 1), submap(world, high, 2, ground_z=GROUND_Z_M + 6.0)
    return i, j, between(low, high)


@pytest.mark.parametrize("height_error_m", [0.0, -3.0, -6.0])
def test_two_decks_are_two_places(height_error_m: float) -> None:
    i, j, true = decks()
    assert judged(i, j, pose(np.eye(3), [0, 0, height_error_m]) @ true).reason


def test_two_decks_are_two_places_to_one_who_knows_nothing() -> None:
    i, j, _ = decks()
    assert judged(i, j, None).reason


def test_the_same_houses_on_other_ground_are_another_street() -> None:
    j = street("again")
    true = between(SOUTH, AGAIN)
    assert judged(street("south"), j, true).reason == ""

    def heaved(height_m: float) -> Submap:
        points = j.points.copy()
        points[:, 2] += height_m * np.sin(points[:, 0] / 3.0) * np.cos(points[:, 1] / 4.0)
        return dataclasses.replace(j, points=points)

    assert judged(street("south"), heaved(0.005), true).reason == ""
    assert "another relief" in judged(street("south"), heaved(0.12), true).reason


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        ({"max_rmse_m": 1e-3}, "doubtful, 3 of 4 indicators agree: residuals"),
        ({"max_rmse_m": 1e-3, "max_e1_m": 1e-6}, "doubtful, 2 of 4 indicators agree: residuals"),
        ({"max_rmse_m": 1e-3, "max_e1_m": 1e-6, "min_inlier_ratio": 1.0}, "only"),
    ],
)
def test_a_loop_in_doubt_is_refused_and_says_so(limits: dict[str, float], says: str) -> None:
    v = judged(
        street("south"), street("again"), between(SOUTH, AGAIN), VerificationSettings.model_validate(limits)
    )
    assert v.reason.startswith(says)


def candidate(predicted: F8) -> Candidate:
    return Candidate(0, 0, 0, 1, float("nan"), float("nan"), predicted, 0.0)


@pytest.mark.parametrize(
    ("drift", "believed"), [(Drift(60.0), False), (Drift(60.0, 1.0, 0.3), True), (Drift(1500.0), True)]
)
def test_odometry_that_says_otherwise_is_believed_as_far_as_it_knows(drift: Drift, believed: bool) -> None:
    predicted = between(SOUTH, AGAIN) @ FAR_OFF
    v = verify(VerificationSettings(), candidate(predicted), drift, street("south"), street("again"))
    assert (v.reason == "") == believed
    assert believed or "contradicts odometry" in v.reason


def test_what_odometry_places_far_away_is_not_even_looked_at() -> None:
    away = pose(np.eye(3), [60.0, 0.0, 0.0])
    v = verify(VerificationSettings(), candidate(away), Drift(100.0), street("south"), street("again"))
    assert v.reason == "contradicts odometry by more than 40 m after 100 m"


def test_drift_that_is_allowed() -> None:
    settings = VerificationSettings()
    assert Drift(0.0).allowed_m(settings) == settings.drift_m
    assert Drift(1000.0).allowed_m(settings) == pytest.approx(3.0 + 4 * 5.0)
    assert Drift(1000.0, 12.0).allowed_m(settings) == pytest.approx(3.0 + 4 * 13.0)
    assert Drift(1000.0, 12.0).allowed_lift_m(settings) == pytest.approx(1.0 + 4 * 3.0)


def test_where_is_looked() -> None:
    settings, i, j = VerificationSettings(), street("south"), street("again")
    nan = float("nan")
    near = prior_of(settings, pose(np.eye(3), [3, 4, 1]), nan, i, j)
    assert np.hypot(near.x_m, near.y_m) == pytest.approx(5.0, abs=0.1)
    assert not near.all_around
    far = prior_of(settings, pose(np.eye(3), [30, 40, 1]), nan, i, j)
    assert np.hypot(far.x_m, far.y_m) == pytest.approx(settings.reach_m, abs=0.1)
    assert prior_of(settings, None, nan, i, j).all_around
    assert prior_of(settings, None, 0.3, i, j).all_around
    assert prior_of(settings, np.eye(4), np.radians(40.0), i, j).all_around
    assert not prior_of(settings, np.eye(4), np.radians(20.0), i, j).all_around
