"""Candidates: who is near by odometry, who is far whatever it looks like, how they are thinned."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import inverse, se3_exp
from scanloom.stages.loops.candidates import admitted_before, queries_of
from scanloom.stages.loops.position import PositionSettings, Whereabouts, accumulated
from tests.stages.loops.worlds import START_NS, block, odometry_of, polyline, scans_of

F8 = np.ndarray


def straight(count: int, step_m: float = 1.0, covariance: F8 | None = None) -> Odometry:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = step_m * np.arange(count)
    return with_poses(T, covariance)


def with_poses(T: F8, covariance: F8 | None = None) -> Odometry:
    scans = scans_of(block(0), T[:1]) * len(T)
    odometry = odometry_of(T, scans, 0.0)
    odometry.T_odom_lidar[:] = T
    odometry.covariance[:] = np.eye(6) * 1e-8 if covariance is None else covariance
    return odometry


def whereabouts(odometry: Odometry) -> Whereabouts:
    p = odometry.T_odom_lidar[:, :3, 3]
    travelled = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))))
    return Whereabouts(p, accumulated(odometry), travelled)


def there_and_back(beside_m: float, up_m: float = 0.0) -> Odometry:
    """120 m along x and back, `beside_m` to the left."""
    x = np.concatenate((np.arange(0, 120.0), np.arange(120.0, 0, -1)))
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, 0, 3] = x
    T[120:, 1, 3], T[120:, 2, 3] = beside_m, up_m
    return with_poses(T)


SURE = PositionSettings(drift_share=0.0)


@pytest.mark.parametrize(("beside_m", "near"), [(14.9, True), (15.1, False)])
def test_near_is_a_radius_at_least(beside_m: float, near: bool) -> None:
    place, share = whereabouts(there_and_back(beside_m)).nearest_earlier(
        SURE, np.array([220]), np.array([120])
    )
    assert bool(place[0] == 20) is near
    assert share[0] == pytest.approx(beside_m / 15 if near else 1.0)


@pytest.mark.parametrize(("up_m", "near"), [(3.9, True), (4.1, False)])
def test_decks_are_not_near(up_m: float, near: bool) -> None:
    place, _ = whereabouts(there_and_back(2.0, up_m)).nearest_earlier(SURE, np.array([220]), np.array([120]))
    assert bool(place[0] >= 0) is near


def test_the_marginal_of_odometry_makes_more_things_near() -> None:
    """After n motions of sigma s each, white: 3 s sqrt(n)."""
    odometry = there_and_back(24.0)
    odometry.covariance[:] = np.diag([1e-18] * 3 + [0.36] * 3)
    reach = 3 * 0.6 * np.sqrt(200)
    place, share = whereabouts(odometry).nearest_earlier(SURE, np.array([220]), np.array([120]))
    assert 19 <= place[0] <= 21
    assert share[0] == pytest.approx(24.0 / reach, rel=0.03)


def test_a_turn_of_unknown_size_moves_what_lies_far_ahead() -> None:
    """sigma of the heading at the start times the distance across it, in closed form and by sampling."""
    odometry = straight(101)
    odometry.covariance[:] = np.eye(6) * 1e-18
    odometry.covariance[1] = np.diag([1e-18, 1e-18, 0.01**2, 1e-18, 1e-18, 1e-18])
    W = accumulated(odometry)[100] - accumulated(odometry)[0]
    p = odometry.T_odom_lidar[100, :3, 3]
    J = np.array([[0, 0, -p[1], 1, 0, 0], [0, 0, p[0], 0, 1, 0]], float)
    sigma = np.sqrt((J @ W @ J.T)[1, 1])
    assert sigma == pytest.approx(0.01 * 99, rel=1e-6)
    rng = np.random.default_rng(0)
    turned = se3_exp(np.column_stack((np.zeros((4000, 2)), rng.normal(0, 0.01, 4000), np.zeros((4000, 3)))))
    ends = odometry.T_odom_lidar[1] @ turned @ inverse(odometry.T_odom_lidar[1]) @ odometry.T_odom_lidar[100]
    assert np.std(ends[:, 1, 3]) == pytest.approx(sigma, rel=0.05)


def test_the_nearest_is_found_as_by_brute_force() -> None:
    T = polyline([(0, 0), (150, 0), (150, 60), (0, 60), (0, 9), (140, 9)])
    place = whereabouts(with_poses(T))
    queries = np.arange(0, len(T), 3)
    admitted = admitted_before(place.travelled_m, START_NS + np.arange(len(T)) * 10**9, queries, 50.0, 30.0)
    found, _ = place.nearest_earlier(PositionSettings(max_radius_m=20.0), queries, admitted)
    for k, (j, m) in enumerate(zip(queries, admitted, strict=True)):
        distance = np.linalg.norm(place.position_m[:m, :2] - place.position_m[j, :2], axis=1)
        assert found[k] == (np.argmin(distance) if m and distance.min() < 15 else -1)


def test_what_odometry_rules_out() -> None:
    place = whereabouts(there_and_back(0.0))
    i, j = np.array([[20, 51, 49]]), np.array([[220, 220, 220]])
    np.testing.assert_array_equal(place.ruled_out(SURE, i, j), [[False, True, False]])


@pytest.mark.parametrize(("path_m", "time_s", "admitted"), [(50, 0, 151), (0, 30, 171), (50, 60, 141)])
def test_only_places_left_long_ago_are_admitted(path_m: float, time_s: float, admitted: int) -> None:
    travelled, stamps = np.arange(300.0), START_NS + np.arange(300, dtype=np.int64) * 10**9
    assert admitted_before(travelled, stamps, np.array([200]), path_m, time_s)[0] == admitted


def test_one_search_per_stretch() -> None:
    assert queries_of(np.array([0.0, 0.9, 1.8, 2.1, 3.9, 8.0]), 2.0).tolist() == [0, 3, 5]


def test_what_is_unknown_between_segments_leaves_the_rest_exact() -> None:
    odometry = straight(200)
    odometry.covariance[:] = np.eye(6) * 1e-6
    whole = accumulated(odometry)
    odometry.segment[120:] = 1
    odometry.covariance[120] = np.eye(6) * 1e12
    split = accumulated(odometry)
    for i, j in ((10, 110), (130, 190)):
        np.testing.assert_allclose(split[j] - split[i], whole[j] - whole[i], rtol=1e-6, atol=1e-12)
