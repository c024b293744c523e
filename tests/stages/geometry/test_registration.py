"""Alignment against exact truth, its information against finite differences, its honesty about degeneracy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from scanloom.stages.geometry.degeneracy import (
    BLIND_STD_M,
    INDICATORS,
    PATCH_RAD,
    blind,
    indicator,
    judge,
)
from scanloom.stages.geometry.registration import VoxelMap, align, normals_at
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, se3_log, so3_exp, transform
from scanloom.stages.geometry.surfaces import eigen_symmetric_3
from scanloom.stages.geometry.voxels import downsample
from tests.worlds import GROUND_Z_M, BoxWorld, observe, street

NOISE_M = 0.02


def tunnel() -> BoxWorld:
    """Walls and roof without end."""
    walls = [
        [[-500, 4, GROUND_Z_M], [500, 6, 5]],
        [[-500, -6, GROUND_Z_M], [500, -4, 5]],
        [[-500, -6, 3.5], [500, 6, 5]],
    ]
    return BoxWorld(np.array(walls, float))


def seen_from(world: BoxWorld, T: F8, seed: int, noise_m: float = NOISE_M) -> F8:
    scan = observe(world, T, rng=np.random.default_rng(seed), noise_m=noise_m, rows=24, columns=600)
    return scan.points().astype(float)


def local_map(world: BoxWorld, noise_m: float = NOISE_M, scans: int = 6) -> VoxelMap:
    voxels = VoxelMap(1.0)
    for k in range(scans):
        T = pose(np.eye(3), [k - scans / 2, 0, 0])
        voxels.insert(transform(T, seen_from(world, T, 100 + k, noise_m)))
    return voxels


@pytest.fixture(scope="module")
def street_map() -> VoxelMap:
    return local_map(street(2))


def test_eigen_decomposition_agrees_with_lapack() -> None:
    rng = np.random.default_rng(0)
    for k in range(50):
        root = rng.normal(size=(3, 3 if k % 2 else 1))
        a = root @ root.T * 10.0 ** rng.integers(-6, 3)
        diagonal, vectors = a.copy(), np.empty((3, 3))
        eigen_symmetric_3(diagonal, vectors)
        values = np.diagonal(diagonal)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(a), atol=1e-9 * np.trace(a))
        np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, a, atol=1e-9 * np.trace(a))


def test_a_known_motion_is_found_between_noise_bounds(street_map: VoxelMap) -> None:
    errors = []
    for k in range(6):
        truth = pose(so3_exp([0.01, -0.02, 0.05 * k]), [0.5 * k, 0.3, 0.05])
        source = seen_from(street(2), truth, k)
        start = truth @ se3_exp([0.01, 0.01, -0.03, 0.2, -0.2, 0.1])
        found = align(street_map, source[downsample(source, 1.0)], start, max_distance_m=1.0, scale_m=0.2)
        assert found.converged
        assert found.inlier_ratio > 0.5
        assert 0.5 * NOISE_M < found.rmse_m < 3 * NOISE_M
        errors.append(se3_log(inverse(truth) @ found.T_target_source))
    rotation, translation = np.sqrt((np.array(errors).reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    assert 0.0003 < translation < 0.015
    assert 1e-5 < rotation < 1e-3


def test_alignment_of_the_map_with_itself_is_exact(street_map: VoxelMap) -> None:
    truth = pose(so3_exp([0, 0, 0.3]), [1, 2, 0.1])
    source = transform(inverse(truth), street_map.points()[::7])
    start = truth @ se3_exp([0.0, 0.01, 0.02, 0.1, -0.1, 0.05])
    found = align(street_map, source, start, max_distance_m=1.0, scale_m=0.1)
    error = se3_log(inverse(truth) @ found.T_target_source)
    assert np.linalg.norm(error[3:]) < 2e-3
    assert np.linalg.norm(error[:3]) < 2e-4


def test_information_is_the_hessian_of_the_weighted_cost(street_map: VoxelMap) -> None:
    source = seen_from(street(2), np.eye(4), 5)[::5]
    found = align(street_map, source, np.eye(4), max_distance_m=1.0, scale_m=0.2)
    T = found.T_target_source
    anchored = transform(T, found.points)
    normals = found.normals @ T[:3, :3].T

    def residuals(xi: F8) -> F8:
        return ((transform(T @ se3_exp(xi), found.points) - anchored) * normals).sum(axis=1)

    step = 1e-5
    J = np.column_stack([(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(6)])
    numeric = J.T @ (found.weights[:, None] * J)
    np.testing.assert_allclose(found.information, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())


def test_the_same_input_gives_the_same_bytes() -> None:
    source = seen_from(street(2), np.eye(4), 5)
    runs = [
        align(
            local_map(street(2), scans=3),
            source,
            se3_exp([0, 0, 0.01, 0.1, 0, 0]),
            max_distance_m=1,
            scale_m=0.1,
        )
        for _ in range(2)
    ]
    assert runs[0].T_target_source.tobytes() == runs[1].T_target_source.tobytes()
    assert runs[0].information.tobytes() == runs[1].information.tobytes()


def test_too_few_points_do_not_converge(street_map: VoxelMap) -> None:
    for source in (np.zeros((0, 3)), np.full((5, 3), 1.0), np.full((300, 3), 5000.0)):
        found = align(street_map, source, np.eye(4), max_distance_m=1.0, scale_m=0.1)
        assert not found.converged
        assert np.isfinite(found.T_target_source).all()
        assert judge(found).p.max() == 0


def test_the_tunnel_is_weak_along_its_axis_and_the_street_is_not(street_map: VoxelMap) -> None:
    for seed in range(3):
        found = align(
            local_map(tunnel()),
            seen_from(tunnel(), np.eye(4), seed)[::3],
            np.eye(4),
            max_distance_m=1,
            scale_m=0.1,
        )
        seen = judge(found)
        assert seen.p[0] < 0.5
        assert seen.p[1:].min() > 0.9
        assert abs(seen.directions[3, 0]) > 0.98, "the weakest direction is the driving axis"
        assert seen.d < 0.01
        assert seen.observed(0.5).shape == (6, 5)

        found = align(
            street_map, seen_from(street(2), np.eye(4), seed)[::3], np.eye(4), max_distance_m=1, scale_m=0.1
        )
        well = judge(found)
        assert well.p.min() > 0.9
        assert well.d > 0.03
        assert well.e_m < seen.e_m


def test_held_directions_stay_at_the_start() -> None:
    source = seen_from(tunnel(), np.eye(4), 1)[::3]
    start = pose(np.eye(3), [0.3, 0.1, 0.05])
    voxels = local_map(tunnel())
    seen = judge(align(voxels, source, start, max_distance_m=1.0, scale_m=0.2))
    found = align(voxels, source, start, max_distance_m=1.0, scale_m=0.2, free=seen.observed(0.5))
    assert abs(found.T_target_source[0, 3] - 0.3) < 0.02
    assert np.abs(found.T_target_source[1:3, 3]).max() < 0.01


def test_residuals_and_gradient_belong_to_the_result(street_map: VoxelMap) -> None:
    source = seen_from(street(2), np.eye(4), 5)[::5]
    found = align(street_map, source, se3_exp([0, 0, 0.01, 0.1, 0, 0]), max_distance_m=1.0, scale_m=0.2)
    J = np.column_stack((np.cross(found.points, found.normals), found.normals))
    np.testing.assert_allclose(
        found.gradient, J.T @ (found.weights * found.residuals), atol=1e-9 * len(J) * np.abs(J).max()
    )
    step = np.linalg.solve(found.information, found.gradient)
    assert np.linalg.norm(step[3:]) < 2e-3
    inside = np.abs(found.residuals) <= 0.2
    assert found.rmse_m == pytest.approx(np.sqrt((found.residuals[inside] ** 2).mean()))


def test_plane_to_plane_finds_the_motion_too(street_map: VoxelMap) -> None:
    errors = []
    for k in range(4):
        truth = pose(so3_exp([0.01, -0.02, 0.05 * k]), [0.5 * k, 0.3, 0.05])
        fine = seen_from(street(2), truth, k)
        source = fine[downsample(fine, 1.0)]
        normals = normals_at(source, fine, 1.0)
        lengths = np.linalg.norm(normals, axis=1)
        assert ((np.abs(lengths - 1) < 1e-6) | (lengths == 0)).all()
        assert (lengths > 0).mean() > 0.3
        start = truth @ se3_exp([0.01, 0.01, -0.03, 0.2, -0.2, 0.1])
        found = align(street_map, source, start, max_distance_m=1.0, scale_m=0.2, source_normals=normals)
        assert found.converged
        errors.append(se3_log(inverse(truth) @ found.T_target_source))
    rotation, translation = np.sqrt((np.array(errors).reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    assert 0.0003 < translation < 0.02
    assert 1e-5 < rotation < 2e-3


def test_plane_to_plane_with_parallel_normals_is_nearly_point_to_plane(street_map: VoxelMap) -> None:
    source = seen_from(street(2), np.eye(4), 5)[::5]
    settings = {"max_distance_m": 1.0, "scale_m": 0.2, "max_iterations": 1}
    points = align(street_map, source, np.eye(4), **settings)
    zero = align(street_map, source, np.eye(4), source_normals=np.zeros_like(source), **settings)
    error = se3_log(inverse(points.T_target_source) @ zero.T_target_source)
    assert np.abs(error[3:]).max() < 2e-3
    np.testing.assert_allclose(
        zero.information, points.information, rtol=0.05, atol=0.02 * np.abs(points.information).max()
    )


def test_what_was_known_before_holds_the_pose_as_firmly_as_it_was_known(street_map: VoxelMap) -> None:
    truth = np.eye(4)
    fine = seen_from(street(2), truth, 7)
    source = fine[downsample(fine, 1.0)]
    start = se3_exp([0, 0, 0.0, 0.05, 0, 0])
    left = []
    for std_m in (1e-5, 2e-3, 10.0):
        held = np.diag([1.0] * 3 + [std_m**-2] * 3)
        found = align(street_map, source, start, max_distance_m=1.0, scale_m=0.2, held=held)
        left.append(found.T_target_source[0, 3])
    assert left[0] == pytest.approx(0.05, abs=2e-3)
    assert left[0] > left[1] > left[2]
    assert abs(left[2]) < 0.015
    free = align(street_map, source, start, max_distance_m=1.0, scale_m=0.2)
    assert left[2] == pytest.approx(free.T_target_source[0, 3], abs=1e-3)


def test_a_registration_says_how_well_it_knows_each_direction() -> None:
    found = align(
        local_map(tunnel()),
        seen_from(tunnel(), np.eye(4), 1)[::3],
        np.eye(4),
        max_distance_m=1.0,
        scale_m=0.1,
    )
    seen = judge(found)
    information = seen.scan_information(0.5)
    np.testing.assert_array_equal(information, information.T)
    assert information[3, 3] < 1e-3 * information[4, 4], "nothing along the axis"
    std = 1 / np.sqrt(np.diagonal(information)[4:])
    assert (std > 1e-4).all()
    assert (std < 0.01).all()
    np.testing.assert_allclose(seen.scan_information(0.5, 4.0), information / 4, rtol=1e-6, atol=1e-3)
    assert np.abs(blind().scan_information(0.5)).max() == 0


def test_correlated_residuals_count_less(street_map: VoxelMap) -> None:
    """A whole patch of points off by the same amount is no better known than a single such error."""
    found = align(
        street_map, seen_from(street(2), np.eye(4), 3)[::3], np.eye(4), max_distance_m=1, scale_m=0.2
    )
    rng = np.random.default_rng(0)
    sigma = float(np.sqrt(found.sigma2))
    independent = dataclasses.replace(found, residuals=rng.normal(0, sigma, len(found.points)))
    azimuth = np.arctan2(found.points[:, 1], found.points[:, 0])
    sector = np.floor(azimuth / PATCH_RAD[0]).astype(int)
    shared = dataclasses.replace(found, residuals=rng.normal(0, sigma, 99)[sector])
    mean = [np.trace(judge(r).scatter) for r in (independent, shared)]
    assert mean[1] > 3 * mean[0]
    plain = np.trace(np.diag(judge(found).eigenvalues)) * found.sigma2
    assert 0.3 * plain < mean[0] < 2 * plain


def test_the_forms_of_e(street_map: VoxelMap) -> None:
    source = seen_from(street(2), np.eye(4), 3)[::3]
    good = align(street_map, source, np.eye(4), max_distance_m=1, scale_m=0.1)
    stray = align(
        street_map,
        source,
        pose(so3_exp([0, 0, 0.8]), [9, 4, 0]),
        max_distance_m=1,
        scale_m=0.1,
        max_iterations=2,
    )
    for kind in INDICATORS:
        assert 0 < indicator(good, kind) < indicator(stray, kind) <= BLIND_STD_M, kind
        assert judge(good, kind=kind).e_m == indicator(good, kind)
    H = np.linalg.inv(good.information)[3:, 3:]
    assert indicator(good, "E1") == pytest.approx(np.sqrt(good.sigma2 * np.linalg.eigvalsh(H)[-1]), rel=1e-6)
    assert indicator(good, "E2") == pytest.approx(good.rmse_m / good.inlier_ratio)
    nothing = align(street_map, np.full((300, 3), 5000.0), np.eye(4), max_distance_m=1, scale_m=0.1)
    assert {indicator(nothing, kind) for kind in INDICATORS} == {BLIND_STD_M}
