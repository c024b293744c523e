"""Correlative search: branch and bound finds exactly what trying every pose finds."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.se3 import inverse, pose, se3_log, so3_exp, transform
from scanloom.stages.loops import correlation
from scanloom.stages.loops.columns import CELL_M, columns, pyramid, score
from scanloom.stages.loops.correlation import Prior, peaks

LOW_M = -10.0


def every_pose(grid: np.ndarray, cells: np.ndarray, bits: np.ndarray, reach: int, reach_z: int) -> np.ndarray:
    """Scores (a, x, y, z) of the whole window."""
    n, m = 2 * reach + 1, 2 * reach_z + 1
    out = np.zeros((len(cells), n, n, m), np.int64)
    for a, x, y, z in np.ndindex(out.shape):
        out[a, x, y, z] = score(grid[0], cells[a], bits, x - reach, y - reach, z - reach_z)
    return out


def best_of(scores: np.ndarray, around: bool, most: int, share: float, least: int) -> list[tuple[int, ...]]:
    """Places that no other within 2 steps of heading and 2 cells beats, and their scores, best first, ties in order."""
    order = np.argsort(-scores.ravel(), kind="stable")
    rank = np.empty(scores.size, np.int64)
    rank[order] = np.arange(scores.size)
    rank = rank.reshape(scores.shape)
    grid = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 4, indexing="ij"), -1).reshape(-1, 4)
    near = grid[(grid[:, 1:] ** 2).sum(axis=1) <= 4]
    out = []
    for flat in order:
        place = np.array(np.unravel_index(flat, scores.shape))
        value = int(scores.ravel()[flat])
        if len(out) == most or value < max(least, int(np.ceil(share * scores.max()))):
            break
        beside = place + near
        if around:
            beside[:, 0] %= scores.shape[0]
        beside = beside[((beside >= 0) & (beside < scores.shape)).all(axis=1)]
        if (rank[tuple(beside.T)] >= rank[tuple(place)]).all():
            out.append((*(int(p) for p in place), value))
    return out


@pytest.mark.parametrize("seed", range(12))
def test_the_search_finds_what_trying_every_pose_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 40))
    fixed, moving = rng.uniform(-8, 8, (3 * n, 3)), rng.uniform(-8, 8, (n, 3))
    turn = np.pi if seed % 6 == 5 else rng.choice([0.05, 0.1, 0.3])
    reach_m = rng.uniform(0, 1.5) if seed % 6 == 5 else rng.uniform(0, 4)
    prior = Prior(*rng.uniform(-3, 3, 4), reach_m, rng.uniform(0, 2.5), turn)
    grid = pyramid(fixed, LOW_M)
    reach, reach_z = prior.reach
    xy, bits = columns(moving, LOW_M - prior.z_m, reach_z)
    cells = correlation._turned(xy, prior.yaws_rad, prior)
    scores = every_pose(grid, cells, bits, reach, reach_z)
    for most, share, least in ((10, 0.5, 1), (3, 0.9, 1), (10, 0.0, 2), (10, 0.0, int(scores.max()) + 1)):
        places, values = correlation._search(
            grid, cells, bits, reach, reach_z, prior.all_around, most, share, least
        )
        found = [(*place, value) for place, value in zip(places.tolist(), values.tolist(), strict=True)]
        assert found == best_of(scores, prior.all_around, most, share, least)


def room(rng: np.random.Generator, n: int = 4000) -> np.ndarray:
    """Walls of an odd room with pillars, m."""
    corners = np.array([[-20, -12], [18, -15], [22, 9], [3, 14], [-1, 6], [-22, 11]], float)
    k = rng.integers(0, len(corners), n)
    along = rng.uniform(size=(n, 1))
    xy = corners[k] + along * (np.roll(corners, -1, axis=0)[k] - corners[k])
    return np.column_stack((xy, rng.uniform(-1.5, 5.0 + k, n)))


@pytest.mark.parametrize(("yaw_deg", "reach_deg"), [(12.0, 30.0), (-178.0, 180.0), (95.0, 180.0)])
def test_a_room_is_found_where_it_is(yaw_deg: float, reach_deg: float) -> None:
    rng = np.random.default_rng(3)
    true = pose(so3_exp([0, 0, np.radians(yaw_deg)]), np.array([5.3, -7.8, 2.1]))
    j = transform(inverse(true), room(rng))
    found = peaks(
        pyramid(room(rng), LOW_M), LOW_M, j, Prior(0, 0, 0, 0, 10, 5, np.radians(reach_deg)), 10, 0.6, 0.3
    )
    off = se3_log(inverse(true) @ found[0].T_i_j)
    assert np.linalg.norm(off[3:]) < 2 * CELL_M
    assert np.degrees(np.linalg.norm(off[:3])) < 2.0
    assert 0.6 < found[0].score <= 1.0


def test_peaks_are_distinct_sorted_and_the_same_every_time() -> None:
    rng = np.random.default_rng(5)
    row = np.concatenate(
        [room(rng, 500) * 0.1 + np.array([x, y, 0]) for x in range(-30, 31, 5) for y in (-8, 8)]
    )
    grid, prior = pyramid(row, LOW_M), Prior(0, 0, 0, 0, 10, 2, np.radians(10))
    found = peaks(grid, LOW_M, row, prior, 10, 0.3, 0.1)
    again = peaks(grid, LOW_M, row, prior, 10, 0.3, 0.1)
    assert len(found) >= 5
    assert [p.score for p in found] == sorted((p.score for p in found), reverse=True)
    assert all(
        np.array_equal(p.T_i_j, q.T_i_j) and p.score == q.score for p, q in zip(found, again, strict=True)
    )
    for k, p in enumerate(found):
        for q in found[:k]:
            off = se3_log(inverse(p.T_i_j) @ q.T_i_j)
            assert np.linalg.norm(off[3:]) > 1.0 or np.degrees(np.linalg.norm(off[:3])) > 5.0


def test_nothing_to_compare_gives_no_peak() -> None:
    rng = np.random.default_rng(0)
    prior = Prior(0, 0, 0, 0, 5, 2, 0.3)
    none = np.zeros((0, 3))
    assert peaks(pyramid(none, LOW_M), LOW_M, room(rng), prior, 10, 0.6, 0.3) == []
    assert peaks(pyramid(room(rng), LOW_M), LOW_M, none, prior, 10, 0.6, 0.3) == []
    assert (
        peaks(pyramid(room(rng), LOW_M), LOW_M, room(rng) + np.array([0, 0, 500]), prior, 10, 0.6, 0.3) == []
    )


def test_one_point_fits_where_a_point_is() -> None:
    point = np.array([[3.2, -1.1, 0.4]])
    found = peaks(pyramid(point, LOW_M), LOW_M, point, Prior(0, 0, 0, 0, 3, 2, 0.1), 10, 0.6, 0.3)
    assert found[0].score == 1.0
    assert np.linalg.norm(transform(found[0].T_i_j, point) - point) < CELL_M * np.sqrt(3)
