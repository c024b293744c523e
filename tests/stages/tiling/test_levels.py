"""Levels: every cell of every level has one point, none is lost, octants are runs of rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanloom.schemas.tiles import Tile, levels_of, spacing_m
from scanloom.stages.tiling.levels import morton_codes, ordered
from tests.tiles import tile_of

TILE_M, VOXEL_M = 50.0, 0.1


def cloud(points: int, seed: int, flat: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.uniform([0, 0, -30 * flat], [TILE_M, TILE_M, 80 * flat], (points, 3))).astype(np.float32)


def sorted_rows(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


def xyz(tile: Tile) -> np.ndarray:
    return np.column_stack((tile.x_m, tile.y_m, tile.z_m))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 3000), st.integers(0, 2**31), st.sampled_from([1.0, 0.01]))
def test_union_of_levels_is_the_tile_and_each_level_thins_it(points: int, seed: int, flat: float) -> None:
    given_points = cloud(points, seed, flat)
    tile = tile_of(given_points)
    assert np.array_equal(sorted_rows(xyz(tile)), sorted_rows(given_points))
    assert (np.diff(tile.level.astype(int)) <= 0).all()
    for level in range(1, levels_of(TILE_M, VOXEL_M) + 1):
        cell = spacing_m(level, TILE_M, VOXEL_M)
        everything = np.unique(np.floor(given_points.astype(float) / cell), axis=0)
        kept = np.floor(xyz(tile)[tile.level >= level].astype(float) / cell)
        assert len(kept) == len(everything)  # one in each cell that has any
        assert len(np.unique(kept, axis=0)) == len(kept)


def test_spacings_are_halves_of_the_tile_and_the_finest_is_the_voxel() -> None:
    assert levels_of(50.0, 0.1) == 9
    assert [round(spacing_m(k, 50.0, 0.1), 3) for k in (0, 1, 2, 9)] == [0.1, 0.195, 0.391, 50.0]
    assert levels_of(64.0, 0.125) == 9  # exactly
    assert levels_of(0.1, 0.1) == 0
    assert levels_of(102.4, 0.1) == 10  # as many voxels a side as there may be


def test_octants_are_runs_of_rows() -> None:
    tile = tile_of(cloud(5000, 1))
    code = morton_codes(tile.x_m, tile.y_m, tile.z_m, TILE_M)
    for level in range(4):
        assert (np.diff(code[tile.level == level]) >= 0).all()
    quarter = np.floor(xyz(tile)[tile.level == 0].astype(float) / 12.5)
    changes = np.count_nonzero((np.diff(quarter, axis=0) != 0).any(axis=1))
    assert changes + 1 == len(np.unique(quarter, axis=0))


def test_borders_of_the_tile_stay_in_it() -> None:
    edge = np.array(
        [[0, 0, 0], [TILE_M, TILE_M, TILE_M], [np.nextafter(np.float32(TILE_M), 0)] * 3, [25, 0, -1e-4]]
    )
    code = morton_codes(*(np.ascontiguousarray(c) for c in edge.astype(np.float32).T), TILE_M)
    cube = code >> 30
    assert cube.tolist() == [0, 1, 0, -1]
    assert (code & (2**30 - 1))[[0, 2]].tolist() == [0, 2**30 - 1]


def test_the_point_nearest_to_the_middle_stands_for_a_cell() -> None:
    points = np.array([[1.0, 1.0, 1.0], [25.1, 24.9, 25.2], [40.0, 40.0, 40.0]])
    order, level = ordered(*(np.ascontiguousarray(c) for c in points.astype(np.float32).T), TILE_M, VOXEL_M)
    assert order[0] == 1
    assert level[0] == 9
    assert sorted(level[1:]) == [8, 8]  # the octants of the other two


def test_levels_are_row_groups_and_a_reader_may_stop(tmp_path: Path) -> None:
    tile = tile_of(cloud(20_000, 3, 0.01))
    groups = tile.row_groups()
    assert sum(groups) == len(tile)
    assert len(groups) == 5
    tile.write(tmp_path / "tile.parquet")
    for count in range(len(groups) + 1):
        part = Tile.open(tmp_path / "tile.parquet", groups=count)
        assert part.to_arrow().equals(tile.take(slice(0, sum(groups[:count]))).to_arrow())
    empty = tile.take(slice(0, 0))
    empty.write(tmp_path / "empty.parquet")
    assert len(Tile.open(tmp_path / "empty.parquet")) == 0


@pytest.mark.parametrize("points", [0, 1, 2])
def test_few_points(points: int) -> None:
    tile = tile_of(cloud(points, 0))
    assert len(tile) == points
    assert tile.level.max(initial=9) == 9
