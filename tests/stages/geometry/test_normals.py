"""Normals: of planes with noise, towards the sensor, and none where there is no plane."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.normals import normals

SIDE, HEIGHT = 1 << 29, 1 << 19


def of(points: np.ndarray, sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points as they come out, one in each voxel of 0.1 m, and their normals."""
    voxel = np.floor(points / 0.1).astype(np.int64)
    key = voxel[:, 0] * SIDE + voxel[:, 1] * HEIGHT + voxel[:, 2] + (1 << 18)
    key, first = np.unique(key, return_index=True)
    kept = points[first]
    towards = sensor - kept
    view = np.rint(127 * towards / np.linalg.norm(towards, axis=1)[:, None]).astype(np.int8)
    x, y, z = (np.ascontiguousarray(c) for c in kept.T)
    return kept, normals(key, x, y, z, view, SIDE, HEIGHT, 25.0)


def plane(normal: np.ndarray, noise_m: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    across = np.linalg.svd(normal[None])[2][1:]
    return (
        np.array([10.0, 10, 10])
        + rng.uniform(-2, 2, (6000, 2)) @ across
        + rng.normal(0, noise_m, (6000, 1)) * normal
    )


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, 1, 0), (1, 1, 1), (1, -2, 0.3)])
@pytest.mark.parametrize("noise_m, low_deg, high_deg", [(0.0, 0.0, 0.5), (0.01, 0.3, 8.0), (0.02, 0.6, 16.0)])
def test_planes(normal: tuple[float, ...], noise_m: float, low_deg: float, high_deg: float) -> None:
    n = np.array(normal, float) / np.linalg.norm(normal)
    sensor = np.array([10.0, 10, 10]) + 5 * n
    _, found = of(plane(n, noise_m), sensor)
    some = np.abs(found).any(axis=1)
    assert some.mean() > 0.95
    length = np.linalg.norm(found[some].astype(float), axis=1)
    assert np.abs(length - 127).max() < 2
    angle = np.degrees(np.arccos(np.clip(found[some] @ n / length, -1, 1)))
    assert low_deg <= np.median(angle) <= high_deg
    assert (angle < 90).all()  # towards the sensor


def test_the_other_side_of_a_wall_looks_the_other_way() -> None:
    n = np.array([1.0, 0, 0])
    _, front = of(plane(n, 0.0), np.array([15.0, 10, 10]))
    _, back = of(plane(n, 0.0), np.array([5.0, 10, 10]))
    assert (front == -back).all()


def test_leaves_and_lonely_points_have_none() -> None:
    rng = np.random.default_rng(0)
    _, leaves = of(rng.uniform(0, 2, (4000, 3)), np.array([9.0, 0, 0]))
    assert np.abs(leaves).any(axis=1).mean() < 0.1
    _, few = of(
        np.array([[0.05, 0.05, 0.05], [0.15, 0.05, 0.05], [0.05, 0.15, 0.05], [3, 3, 3]]), np.zeros(3)
    )
    assert (few == 0).all()


def test_the_two_borders_of_a_full_tile_are_not_neighbours() -> None:
    """With 1024 voxels a side the number after the last voxel of a row is the first of the next."""
    y = np.array([102.35, 102.35, 102.35, 0.05, 0.05, 0.05])
    points = np.column_stack((np.repeat([0.05, 0.15], 3), y, np.tile([0.05, 0.15, 0.25], 2)))
    _, found = of(points, np.zeros(3))
    assert (found == 0).all()
