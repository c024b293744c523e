"""The map of surfaces against sums in plain Python, and steps against linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.descent import solve
from scanloom.stages.geometry.registration import align
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, se3_log, so3_exp, transform
from scanloom.stages.geometry.surfel_map import LEAST_AROUND, SurfelMap
from scanloom.stages.geometry.voxels import downsample
from tests.worlds import observe, street

NOISE_M = 0.02


def surfaces(voxels: SurfelMap, points: F8, reach_m: float = 1.0) -> tuple[F8, F8, F8, F8]:
    n = len(points)
    found = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n)
    voxels.partners(points, np.eye(4), reach_m, *found)
    return found


def wall(count: int, seed: int, noise_m: float = 0.01) -> F8:
    """Points of the plane x = 0.3."""
    rng = np.random.default_rng(seed)
    return np.column_stack((0.3 + noise_m * rng.standard_normal(count), rng.uniform(-4, 4, (count, 2))))


def test_a_surface_is_that_of_the_27_cells_around() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (400, 3)) * [1, 1, 0.02] + np.array([0, 0, 0.25])
    voxels = SurfelMap(1.0, points_per_cell=1000)
    assert voxels.insert(points) == len(voxels) == 400
    mean, normal, shape, variance = surfaces(voxels, points)
    for n in range(0, 400, 20):
        cell = np.floor(points[n] / 0.5)
        near = points[(np.abs(np.floor(points / 0.5) - cell) <= 1).all(axis=1)]
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        np.testing.assert_allclose(mean[n], near.mean(axis=0), atol=1e-5)
        assert abs(normal[n] @ vectors[:, 0]) > 1 - 1e-6
        assert (shape[n] > 0) == (len(near) >= LEAST_AROUND)
        assert variance[n] == pytest.approx(values[0] / ((len(near) - 3) * values[1]), rel=0.02)


@pytest.mark.parametrize("count", [LEAST_AROUND - 1, LEAST_AROUND])
def test_a_surface_needs_enough_points(count: int) -> None:
    angle = 2 * np.pi * np.arange(count) / count
    ring = np.column_stack((0.5 + 0.4 * np.cos(angle), 0.5 + 0.4 * np.sin(angle), np.full(count, 0.1)))
    voxels = SurfelMap(1.0)
    voxels.insert(ring)
    assert (surfaces(voxels, ring)[2] > 0).all() == (count == LEAST_AROUND)


def test_full_cells_keep_their_first_points_and_what_is_not_finite_is_passed_over() -> None:
    voxels = SurfelMap(1.0, points_per_cell=5)
    points = np.array([[0.1, 0.1, 0.1]] * 5 + [[0.4, 0.4, 0.4]] * 5 + [[np.nan, 0, 0], [0, np.inf, 0]])
    assert voxels.insert(points) == 5
    np.testing.assert_allclose(voxels.points(), [[0.1, 0.1, 0.1]], atol=1e-6)
    assert voxels.insert(points[:1], pose(np.eye(3), [10.0, 0, 0])) == 1
    assert voxels.points()[:, 0].max() == pytest.approx(10.1, abs=1e-5)


def test_off_the_points_the_nearest_cell_within_reach_is_the_partner() -> None:
    voxels = SurfelMap(1.0)
    voxels.insert(wall(2000, 1))
    beside = np.array([[0.8, 0.2, 0.2], [0.3 + 0.65, 0.2, 0.2], [2.5, 0.2, 0.2]])
    near, little = surfaces(voxels, beside), surfaces(voxels, beside, 0.4)
    np.testing.assert_array_equal(near[2] > 0, [True, True, False])
    assert not little[2].any()
    np.testing.assert_allclose(near[0][:2, 0], 0.3, atol=0.005)


def test_a_surface_is_fitted_again_when_the_map_has_grown() -> None:
    voxels = SurfelMap(1.0, points_per_cell=1000, refit_after=2)
    voxels.insert(wall(2000, 1))
    place = np.array([[0.3, 0.2, 0.2]])
    first = surfaces(voxels, place)[0][0, 0]
    for k in range(3):
        assert surfaces(voxels, place)[0][0, 0] == first, k
        voxels.insert(wall(2000, 2 + k) + np.array([0.1, 0, 0]))
    assert surfaces(voxels, place)[0][0, 0] > first + 0.05


def test_dropping_far_blocks_keeps_the_near_ones_findable() -> None:
    points = np.random.default_rng(3).uniform(-60, 60, (20000, 3)) * [1, 1, 0.01]
    voxels = SurfelMap(1.0)
    voxels.insert(points)
    voxels.drop_far([0, 0, 0], 20.0)
    kept = voxels.points()
    assert 0 < len(kept) < 20000
    assert np.linalg.norm(kept, axis=1).max() < 20 + np.sqrt(3)
    blocks = voxels.blocks
    voxels.insert(kept)
    assert voxels.blocks == blocks, "every block is still found"
    voxels.drop_far([1000, 0, 0], 20.0)
    assert len(voxels) == len(voxels.points()) == 0


@pytest.mark.parametrize("few_first", [1, 2])
def test_a_known_motion_is_found_between_noise_bounds(few_first: int) -> None:
    voxels = SurfelMap(1.0)
    for k in range(6):
        T = pose(np.eye(3), [k - 3.0, 0, 0])
        voxels.insert(seen(T, 100 + k), T)
    errors = []
    for k in range(6):
        truth = pose(so3_exp([0.01, -0.02, 0.05 * k]), [0.5 * k, 0.3, 0.05])
        source = seen(truth, k)
        start = truth @ se3_exp([0.01, 0.01, -0.03, 0.2, -0.2, 0.1])
        some = source[downsample(source, 0.7)]
        assert len(some) > 1200
        found = align(voxels, some, start, max_distance_m=1.0, scale_m=0.2, few_first=few_first)
        assert found.converged
        assert 0.5 * NOISE_M < found.rmse_m < 3 * NOISE_M
        errors.append(se3_log(inverse(truth) @ found.T_target_source))
    rotation, translation = np.sqrt((np.array(errors).reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    assert 0.0003 < translation < 0.015
    assert 1e-5 < rotation < 1e-3


def seen(T: F8, seed: int) -> F8:
    rng = np.random.default_rng(seed)
    return observe(street(2), T, rng=rng, noise_m=NOISE_M, rows=24, columns=600).points().astype(float)


def test_points_moved_by_the_map_are_those_moved_before() -> None:
    T = pose(so3_exp([0.1, 0.2, 0.3]), [5.0, -3.0, 1.0])
    points = np.random.default_rng(4).uniform(-5, 5, (500, 3))
    moved, plain = SurfelMap(1.0), SurfelMap(1.0)
    moved.insert(points, T)
    plain.insert(transform(T, points))
    np.testing.assert_allclose(moved.points(), plain.points(), atol=1e-5)


def test_solve_agrees_with_lapack_and_leaves_out_what_is_not_told() -> None:
    rng = np.random.default_rng(5)
    for k in range(1, 7):
        root = rng.normal(size=(k, 8)) * 10.0 ** rng.integers(-3, 4, (k, 1))
        A, b = root @ root.T, rng.normal(size=k)
        np.testing.assert_allclose(solve(A, b), np.linalg.solve(A, b), rtol=1e-6)
    A = np.diag([2.0, 0.0, 4.0])
    x = solve(A, np.array([2.0, 0.0, 2.0]))
    np.testing.assert_allclose(x, [1.0, 0.0, 0.5], rtol=1e-12)
    assert x[1] == 0.0
