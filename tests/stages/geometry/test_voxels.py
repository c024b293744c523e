"""Keys, downsampling and the voxel map against plain Python."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.registration import VoxelMap
from scanloom.stages.geometry.voxels import downsample, voxel_keys


def test_keys_agree_with_floor_division() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-50, 50, (500, 3))
    cells = np.floor(points / 0.7).astype(int)
    names = {tuple(c) for c in cells}
    keys = voxel_keys(points, 0.7)
    assert len(set(keys.tolist())) == len(names)
    for key in np.unique(keys):
        assert len({tuple(c) for c in cells[keys == key]}) == 1
    assert keys.min() >= 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_downsample_keeps_the_first_of_every_voxel_in_order(dtype: type) -> None:
    points = np.random.default_rng(1).uniform(-5, 5, (2000, 3)).astype(dtype)
    seen: set[int] = set()
    expected = [
        n for n, key in enumerate(voxel_keys(points, 0.5)) if not (int(key) in seen or seen.add(int(key)))
    ]
    np.testing.assert_array_equal(downsample(points, 0.5), expected)


def test_points_that_are_not_finite_or_absent_are_passed_over() -> None:
    points = np.array([[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [3, 0, 0]])
    np.testing.assert_array_equal(downsample(points, 1.0), [0, 3])
    assert (voxel_keys(points, 1.0) == -1).sum() == 2
    assert len(downsample(np.zeros((0, 3), np.float32), 1.0)) == 0
    voxels = VoxelMap(1.0)
    assert voxels.insert(points) == 2
    assert len(voxels) == 2


def test_map_keeps_spacing_and_capacity() -> None:
    points = np.random.default_rng(2).uniform(-3, 3, (30000, 3))
    voxels = VoxelMap(1.0, points_per_voxel=20)
    voxels.insert(points)
    kept = voxels.points()
    assert len(kept) == len(voxels)
    counts = np.unique(voxel_keys(kept, 1.0), return_counts=True)[1]
    assert counts.max() <= 20
    for key in np.unique(voxel_keys(kept, 1.0))[:20]:
        inside = kept[voxel_keys(kept, 1.0) == key]
        apart = np.linalg.norm(inside[:, None] - inside, axis=2) + 9 * np.eye(len(inside))
        assert apart.min() >= voxels.spacing_m - 1e-6


def test_map_stores_far_points_to_a_tenth_of_a_millimetre() -> None:
    points = np.array([[54321.1234, -98765.4321, 12.3456]])
    voxels = VoxelMap(1.0)
    voxels.insert(points)
    np.testing.assert_allclose(voxels.points(), points, atol=1e-4)


def test_dropping_far_voxels_keeps_the_near_ones_findable() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-60, 60, (20000, 3)) * [1, 1, 0.05]
    voxels = VoxelMap(1.0)
    voxels.insert(points)
    voxels.drop_far([0, 0, 0], 20.0)
    kept = voxels.points()
    assert 0 < len(kept) < len(points)
    assert np.linalg.norm(kept, axis=1).max() < 20 + np.sqrt(3)
    assert voxels.insert(kept) == 0, "every kept point is still found"
    voxels.drop_far([1000, 0, 0], 20.0)
    assert len(voxels) == 0
    assert len(voxels.points()) == 0
