"""Coarse search: exact on the grid, the same on every run, right on streets."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.registration import VoxelMap
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_log, so3_exp, transform
from scanloom.stages.geometry.voxels import downsample
from scanloom.stages.odometry.coarse import (
    CELL_M,
    UPRIGHT,
    Window,
    headings,
    occupancy,
    propose,
    rotations,
)
from tests.worlds import observe, street


def seen(seed: int, T: F8, rows: int = 16) -> F8:
    points = observe(street(seed), T, rng=np.random.default_rng(seed), rows=rows).points()
    return points[downsample(points, 1.0)]


def local_map(seed: int, steps: int = 5) -> F8:
    """Points of a few scans along the street, 2.4 m apart."""
    target, rng = VoxelMap(1.0, 20), np.random.default_rng(seed)
    for k in range(steps):
        T = pose(np.eye(3), [2.4 * k, 0, 0])
        target.insert(transform(T, observe(street(seed), T, rng=rng).points()))
    return target.points()


@pytest.mark.parametrize(
    "step",
    [
        pose(np.eye(3), [6.0, 0.3, 0]),
        pose(so3_exp([0, 0, np.radians(48)]), [2.4, 0.2, 0]),
        pose(so3_exp([0, 0, np.radians(-130)]), [1.0, 1.0, 0]),
    ],
    ids=["long way", "48 degrees", "130 degrees"],
)
def test_a_scan_is_found_far_from_where_it_was_expected(step: F8) -> None:
    expected = pose(np.eye(3), [9.6, 0, 0])
    truth = expected @ step
    best = propose(local_map(2), seen(2, truth), expected, np.eye(3), Window(headings(np.pi), 10.0, 2.0))[0]
    error = se3_log(inverse(truth) @ best.T_map_scan)
    assert np.linalg.norm(error[3:]) < 1.5 * CELL_M
    assert np.linalg.norm(error[:3]) < np.radians(3.0), "the grid of headings is no finer"
    assert 0.3 < best.score < 1.0


def test_turns_about_any_axis_are_found() -> None:
    expected = pose(np.eye(3), [9.6, 0, 0])
    truth = expected @ pose(so3_exp([0.3, -0.4, 0.7]), [0.5, 0.5, 0])
    found = propose(
        local_map(2), seen(2, truth), expected, np.eye(3), Window(rotations(np.radians(63)), 3.0, 3.0)
    )
    errors = [se3_log(inverse(truth) @ p.T_map_scan) for p in found]
    assert min(np.linalg.norm(e[:3]) for e in errors) < np.radians(13.0)


def test_tilted_frames_are_searched_in_their_own_plane() -> None:
    """The map's frame is tilted by 30 degrees; the window is meant level."""
    tilt = pose(so3_exp([0.0, np.radians(30), 0]), np.zeros(3))
    truth = pose(so3_exp([0, 0, 0.6]), [14.0, 0.4, 0])
    points = transform(tilt, local_map(2))
    best = propose(
        points, seen(2, truth), tilt @ pose(np.eye(3), [9.6, 0, 0]), tilt[:3, :3].T, Window(headings(np.pi), 6.0, 1.0)
    )[0]  # fmt: skip
    error = se3_log(inverse(tilt @ truth) @ best.T_map_scan)
    assert np.linalg.norm(error[3:]) < 2 * CELL_M
    assert np.linalg.norm(error[:3]) < np.radians(3.0)


def test_the_best_is_that_of_trying_all() -> None:
    """Branch and bound against a plain search of every cell."""
    target, expected = local_map(5), pose(np.eye(3), [9.6, 0, 0])
    scan = seen(5, pose(np.eye(3), [11.8, 0.7, 0.2]))[:300]
    window = Window(headings(np.radians(5.0)), 4.0, 2.0)
    best = propose(target, scan, expected, np.eye(3), window)[0]
    grid = occupancy(target - expected[:3, 3]).astype(int)
    half = np.array(grid.shape) * CELL_M / 2
    highest = 0
    for turn in window.turns_rad:
        near = scan[(scan**2).sum(axis=1) < 48.0**2]
        cell = np.floor((near @ so3_exp(turn).T + half) / CELL_M).astype(int)
        for i in range(-8, 8):
            for j in range(-8, 8):
                for k in range(-4, 4):
                    c = cell + np.array([i, j, k])
                    inside = ((c >= 0) & (c < grid.shape)).all(axis=1)
                    highest = max(highest, int(grid[tuple(c[inside].T)].sum()))
    assert best.score == pytest.approx(highest / (UPRIGHT * len(near)))


def test_same_input_same_bytes() -> None:
    target, scan = local_map(5), seen(5, pose(so3_exp([0, 0, 1.0]), [12.0, 0, 0]))
    a, b = (
        propose(target, scan, pose(np.eye(3), [9.6, 0, 0]), np.eye(3), Window(headings(np.pi), 8.0, 2.0))
        for _ in range(2)
    )
    assert [p.T_map_scan.tobytes() for p in a] == [p.T_map_scan.tobytes() for p in b]
    assert len(a) >= 1


def test_nothing_to_match_gives_no_proposal() -> None:
    some, nothing = local_map(2, steps=1), np.zeros((0, 3))
    window = Window(headings(0.1), 4.0, 1.0)
    assert propose(nothing, some, np.eye(4), np.eye(3), window) == []
    assert propose(some, nothing, np.eye(4), np.eye(3), window) == []
    far = pose(np.eye(3), [500.0, 0, 0])
    assert propose(some, some, far, np.eye(3), window) == [], "the map is not there"


def test_headings_cover_the_circle_once() -> None:
    yaw = np.sort(headings(np.pi)[:, 2])
    assert np.diff(yaw).max() < np.radians(2.51)
    assert yaw[0] >= -np.pi - 1e-9
    assert yaw[-1] <= np.pi + 1e-9
    assert len(headings(0.0)) == 1
