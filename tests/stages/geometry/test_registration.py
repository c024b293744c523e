"""Alignment against exact truth, its information against finite differences, its honesty about degeneracy."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.degeneracy import judge, scan_covariance
from scanloom.stages.geometry.registration import VoxelMap, align
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


def test_covariance_takes_weak_directions_from_the_prediction() -> None:
    found = align(
        local_map(tunnel()),
        seen_from(tunnel(), np.eye(4), 1)[::3],
        np.eye(4),
        max_distance_m=1.0,
        scale_m=0.1,
    )
    seen = judge(found)
    predicted = np.diag([0.01**2] * 3 + [0.5**2] * 3)
    covariance = scan_covariance(
        seen, found.sigma2, inflation=2.0, floor_m=0.002, floor_rad=1e-4, predicted=predicted, least_p=0.5
    )  # fmt: skip
    std = np.sqrt(np.diagonal(covariance))
    assert 0.45 < std[3] < 0.55
    assert std[4:].min() >= 0.002
    assert std[4:].max() < 0.02
    assert np.linalg.eigvalsh(covariance).min() > 0
