from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.stages.calibrate.board import Board, Charuco, read_board
from scanloom.stages.calibrate.cloud import CloudBoard, CloudSettings, Search, search_boards, static_points
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_log, so3_exp, transform
from scanloom.stages.logs.pcd import read_pcd
from tests.stages.calibrate.board_clouds import BOARD, Lidar, Panel, Scene, board_panel, facing, room, scan

DIAMOND = facing(2.4, 20.0, -0.05, 42.0, (12.0, -15.0))
UPRIGHT = facing(2.3, 20.0, -0.05, 88.0, (10.0, 18.0))
NARROW = (-5.0, 45.0)


def searched(
    boards: list[Panel], lidar: Lidar | None = None, seed: int = 0, board: Board = BOARD, **settings: object
) -> Search:
    rng = np.random.default_rng(seed)
    holder = boards[0].T if boards else None
    sensor = lidar or Lidar(sight_deg=NARROW)
    points, light, ring = scan(sensor, Scene(boards, room(holder, rng)), rng)
    return search_boards(points, light, ring, board, None, CloudSettings.model_validate(settings))


def error(found: CloudBoard, T: F8) -> F8:
    """Tangent (6,) from the found pose to the true one, half a turn free."""
    turns = (T, T @ pose(so3_exp([0.0, 0.0, np.pi]), np.zeros(3)))
    both = [se3_log(inverse(found.T_lidar_board) @ turn) for turn in turns]
    return min(both, key=lambda xi: abs(xi[2]))


def sigmas(found: CloudBoard, T: F8) -> F8:
    return np.abs(error(found, T)) / np.sqrt(np.diag(found.covariance))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("T", [DIAMOND, UPRIGHT], ids=["diamond", "upright"])
def test_a_held_board_is_found_where_it_is(T: F8, seed: int) -> None:
    result = searched([board_panel(T)], seed=seed)
    assert len(result.boards) == 1
    board = result.boards[0]
    off = np.abs(error(board, T))
    assert sigmas(board, T).max() < 3.5
    assert 0 < off[:3].max() < np.radians(1.0)
    assert 0 < off[3:5].max() < 0.004 and off[5] < 0.02
    assert board.first_dark is True
    assert 0.8 < board.contrast < 0.999
    assert 0.012 < board.rmse_m < 0.035


def test_errors_are_as_large_as_the_covariance_says() -> None:
    z = np.concatenate(
        [sigmas(searched([board_panel(DIAMOND)], seed=s).boards[0], DIAMOND) for s in range(4)]
    )
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.5


@pytest.mark.parametrize("beams, low, distance", [(32, -25.0, 3.2), (64, -24.8, 4.5)])
def test_more_beams_reach_farther(beams: int, low: float, distance: float) -> None:
    T = facing(distance, 20.0, -0.2, 42.0, (12.0, -15.0))
    found = searched([board_panel(T)], Lidar(beams=beams, low_deg=low, sight_deg=(0.0, 40.0))).boards
    assert len(found) == 1
    assert sigmas(found[0], T).max() < 3.5


def test_measured_size_corners_and_edges() -> None:
    found = searched([board_panel(DIAMOND)]).boards[0]
    assert found.extent_m == pytest.approx(BOARD.board_m, abs=0.03)
    T = found.T_lidar_board
    np.testing.assert_allclose(found.corners_m, transform(T, BOARD.corners_m()), atol=1e-12)
    truth = transform(DIAMOND, BOARD.corners_m())
    off = min(np.abs(found.corners_m - truth).max(), np.abs(found.corners_m - truth[::-1]).max())
    assert 1e-5 < off < 0.02
    assert np.linalg.eigvalsh(found.corner_covariance).min() > 0
    local = transform(inverse(T), found.edge_points_m)
    assert np.abs(local[:, 2]).max() < 1e-9
    corners = BOARD.outline_m()
    for side in range(4):
        a, b = corners[side, :2], corners[(side + 1) % 4, :2]
        along = (b - a) / np.linalg.norm(b - a)
        apart = np.abs((local[found.edge_line == side, :2] - a) @ [-along[1], along[0]])
        assert len(apart) and np.median(apart) < 0.015
    azimuth = np.arctan2(found.edge_points_m[:, 1], found.edge_points_m[:, 0])
    assert azimuth[found.edge_left].mean() > azimuth[~found.edge_left].mean()


def test_without_reflectance_the_edges_decide_and_the_covariance_grows() -> None:
    by_squares = searched([board_panel(DIAMOND)]).boards[0]
    for lidar, settings in (
        (Lidar(sight_deg=NARROW, reflectance=0.0), {}),
        (Lidar(sight_deg=NARROW), {"reflectance": "ignore"}),
    ):
        found = searched([board_panel(DIAMOND)], lidar, **settings).boards
        assert found
        best = min(found, key=lambda b: np.linalg.norm(b.T_lidar_board[:3, 3] - DIAMOND[:3, 3]))
        assert best.first_dark is None and best.contrast == 0
        assert sigmas(best, DIAMOND).max() < 3.5
        assert np.diag(best.covariance)[3:5].min() > 1.2 * np.diag(by_squares.covariance)[3:5].min()
    assert not searched(
        [board_panel(DIAMOND)], Lidar(sight_deg=NARROW, reflectance=0.0), reflectance="require"
    ).boards


def test_reflectance_of_another_scale_gives_the_same() -> None:
    plain = searched([board_panel(DIAMOND)], Lidar(sight_deg=NARROW))
    scaled = searched([board_panel(DIAMOND)], Lidar(sight_deg=NARROW, reflectance=4e4))
    np.testing.assert_allclose(plain.boards[0].T_lidar_board, scaled.boards[0].T_lidar_board, atol=1e-3)


def test_an_upright_board_without_squares_is_uncertain_along_its_upright_sides() -> None:
    T = facing(2.3, 20.0, -0.05, 90.0, (8.0, 0.0))
    best = searched([board_panel(T)], reflectance="ignore").boards[0]
    upright = np.argmax(np.abs(best.T_lidar_board[2, :2]))
    sigma = np.sqrt(np.diag(best.covariance)[3:5])
    assert sigma[upright] > 4 * sigma[1 - upright]
    assert 0.01 < sigma[upright] < 0.1
    assert sigmas(best, T).max() < 3.5


def test_beams_are_told_apart_without_rings() -> None:
    rng = np.random.default_rng(0)
    points, light, ring = scan(Lidar(sight_deg=NARROW), Scene([board_panel(DIAMOND)], room()), rng)
    shuffled = rng.permutation(len(points))
    with_rings = search_boards(points, light, ring, BOARD).boards[0]
    without = search_boards(points[shuffled], light[shuffled], None, BOARD).boards[0]
    off = np.abs(se3_log(inverse(with_rings.T_lidar_board) @ without.T_lidar_board))
    assert off.max() < 1e-3
    assert sorted(shuffled[without.source]) == sorted(with_rings.source)


def test_a_board_behind_the_sensor_is_not_cut_at_the_seam() -> None:
    T = facing(2.4, 180.0, -0.05, 42.0, (12.0, -15.0))
    points, light, ring = scan(Lidar(step_deg=0.3), Scene([board_panel(T)], room()), np.random.default_rng(0))
    found = search_boards(points, light, ring, BOARD).boards
    assert len(found) == 1
    assert sigmas(found[0], T).max() < 3.5


def test_partly_out_of_view() -> None:
    lidar = Lidar(sight_deg=(13.0, 60.0))
    found = searched([board_panel(DIAMOND)], lidar).boards
    assert len(found) == 1
    whole = searched([board_panel(DIAMOND)]).boards[0]
    assert len(found[0].points_m) < 0.9 * len(whole.points_m)
    assert sigmas(found[0], DIAMOND).max() < 3.5


def test_two_boards_in_view() -> None:
    other = facing(2.8, -15.0, 0.0, -40.0, (-15.0, 10.0))
    found = searched([board_panel(DIAMOND), board_panel(other)], Lidar(sight_deg=(-40.0, 45.0))).boards
    assert len(found) == 2
    for T in (DIAMOND, other):
        near = min(found, key=lambda b: np.linalg.norm(b.T_lidar_board[:3, 3] - T[:3, 3]))
        assert sigmas(near, T).max() < 3.5


@pytest.mark.parametrize("T", [DIAMOND, UPRIGHT], ids=["diamond", "upright"])
def test_a_board_with_markers_in_its_squares(T: F8) -> None:
    marked = BOARD.model_copy(update={"charuco": Charuco(dictionary="DICT_5X5_100", marker_m=0.07)})
    result = searched([board_panel(T, marked)], board=marked)
    assert len(result.boards) == 1
    board = result.boards[0]
    off = np.abs(error(board, T))
    assert sigmas(board, T).max() < 3.5
    assert 0 < off[:3].max() < np.radians(1.2)
    assert 0 < off[3:5].max() < 0.006 and off[5] < 0.02
    assert 0.4 < board.contrast < 0.95


def test_no_board_is_no_board() -> None:
    result = searched([], Lidar(sight_deg=(20.0, 75.0)))
    assert not result.boards
    assert result.refused and all(piece.reason for piece in result.refused)


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_a_board_of_another_size_is_refused_with_its_measure(scale: float) -> None:
    other = Board(inner_corners=(7, 5), square_m=0.095 * scale, board_m=(0.85 * scale, 0.61 * scale))
    result = searched([board_panel(DIAMOND, other)])
    assert not result.boards
    near = [r for r in result.refused if np.linalg.norm(r.centre_m - DIAMOND[:3, 3]) < 0.2]
    measured = [float(word) for word in near[0].reason.split() if word.replace(".", "").isdigit()]
    assert measured[0] == pytest.approx(0.85 * scale, abs=0.06)
    assert "the board 0.85 x 0.61 m" in near[0].reason


def test_what_stands_in_the_background_is_not_looked_at() -> None:
    rng = np.random.default_rng(1)
    places = [facing(2.4, a, -0.05, 42.0, (12.0, -15.0)) for a in (-15.0, 20.0, 55.0)]
    poster = board_panel(facing(2.6, -40.0, 0.0, 40.0))
    clouds = [
        scan(Lidar(sight_deg=(-60.0, 80.0), step_deg=0.3), Scene([board_panel(T), poster], room()), rng)
        for T in places
    ]
    for k, T in enumerate(places):
        points, light, ring = clouds[k]
        both = search_boards(points, light, ring, BOARD).boards
        assert len(both) == 2
        static = static_points([cloud[0] for j, cloud in enumerate(clouds) if j != k])
        alone = search_boards(points, light, ring, BOARD, static).boards
        assert len(alone) == 1
        assert np.linalg.norm(alone[0].T_lidar_board[:3, 3] - T[:3, 3]) < 0.02


def test_beams_that_cross_before_the_axis_are_noticed() -> None:
    sensor = Lidar(sight_deg=NARROW, crossing_m=0.06, range_sigma_m=0.008)
    found = [searched([board_panel(DIAMOND)], sensor, seed=s).boards[0] for s in range(3)]
    assert np.mean([b.crossing_m for b in found]) > 0.02
    straight = [searched([board_panel(DIAMOND)], seed=s).boards[0] for s in range(3)]
    assert abs(np.mean([b.crossing_m for b in straight])) < 0.02
    assert max(sigmas(b, DIAMOND).max() for b in found) < 3.5


def test_nothing_and_rubbish() -> None:
    assert search_boards(np.zeros((0, 3)), np.zeros(0), None, BOARD) == Search((), ())
    points = np.full((100, 3), np.nan)
    assert search_boards(points, np.zeros(100), None, BOARD) == Search((), ())
    assert search_boards(np.zeros((100, 3)), np.zeros(100), np.zeros(100, np.int64), BOARD) == Search((), ())


def test_the_same_every_time() -> None:
    a, b = (searched([board_panel(DIAMOND)], seed=4).boards[0] for _ in range(2))
    np.testing.assert_array_equal(a.T_lidar_board, b.T_lidar_board)
    np.testing.assert_array_equal(a.evidence.root, b.evidence.root)


@pytest.mark.real
@pytest.mark.parametrize("name", ["pose1", "pose8", "pose14"])
def test_real_boards(shared_data: Path, name: str) -> None:
    folder = shared_data / "lidar_camera_board"
    cloud, _ = read_pcd((folder / "clouds" / f"{name}.pcd").read_bytes())
    points = np.column_stack([cloud[axis] for axis in "xyz"]).astype(np.float64)
    found = search_boards(
        points, cloud["intensity"], cloud["ring"].astype(np.int64), read_board(folder / "board.yaml")
    ).boards
    assert len(found) == 1
    assert found[0].extent_m == pytest.approx((0.85, 0.61), rel=0.05)
    assert 0.005 < found[0].rmse_m < 0.02
    assert found[0].contrast > 0.75
    assert 0.004 < found[0].darker_m < 0.02
    assert 0.005 < found[0].crossing_m < 0.06
