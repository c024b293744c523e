"""Corners of a drawn board."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.board_scenes import model
from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.board import Board, Charuco
from scanloom.stages.calibrate.grid import pattern_in
from scanloom.stages.calibrate.image import board_turn, charuco_pattern, find_corners, grey, pattern_seen
from scanloom.stages.calibrate.rays import Bearings, on_board
from scanloom.stages.geometry.camera import project, rays
from scanloom.stages.geometry.se3 import inverse, pose, so3_exp, transform

BOARD = Board(inner_corners=(7, 5), square_m=0.095, board_m=(0.85, 0.61))
T_CAMERA_BOARD = pose(np.diag([1.0, -1.0, -1.0]) @ so3_exp([0.3, -0.25, 0.6]), [0.15, -0.1, 1.9])


def drawn(lens: CameraModel, board: Board, T: np.ndarray, seed: int = 0) -> np.ndarray:
    """A board ray by ray, four rays a pixel, with noise; grey around it."""
    u, v = np.meshgrid(np.arange(lens.width_px * 2) / 2 - 0.25, np.arange(lens.height_px * 2) / 2 - 0.25)
    xy = on_board(inverse(T), rays(lens, np.column_stack((u.ravel(), v.ravel()))))
    m, n = board.squares
    cell = np.floor(xy / board.square_m + np.array([m, n]) / 2)
    inside = ((cell >= 0) & (cell < (m, n))).all(axis=1)
    on = (np.abs(xy) < np.array(board.board_m) / 2).all(axis=1)
    value = np.where(inside & (cell.sum(axis=1) % 2 == 0), 25.0, 215.0)
    value = np.where(on, value, 110.0).reshape(u.shape)
    image = cv2.resize(
        value.astype(np.float32), (lens.width_px, lens.height_px), interpolation=cv2.INTER_AREA
    )
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + np.random.default_rng(seed).normal(0, 2.5, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("lens", [0, 1, 2])
def test_corners_of_every_lens(lens):
    m = model(lens)
    found = find_corners(drawn(m, BOARD, T_CAMERA_BOARD), BOARD, m)
    assert found is not None and found.turns == 2
    true, _ = project(m, transform(T_CAMERA_BOARD, BOARD.corners_m()))
    ways = [found.turned(BOARD, turn) for turn in range(2)]
    errors = [np.linalg.norm(way.pixels - true[way.index], axis=1) for way in ways]
    assert min(e.max() for e in errors) < 0.25
    assert max(e.max() for e in errors) > 50
    assert 0.005 < found.sigma_px < 0.15
    best = ways[int(np.argmin([e.max() for e in errors]))]
    np.testing.assert_allclose(best.T_camera_board, T_CAMERA_BOARD, atol=5e-3)
    assert best.T_camera_board[:3, 2] @ best.T_camera_board[:3, 3] < 0


def test_another_board_is_not_taken_for_this_one():
    m = model(2)
    image = drawn(m, BOARD, T_CAMERA_BOARD)
    for size in ((6, 4), (5, 4), (8, 6)):
        assert find_corners(image, BOARD.model_copy(update={"inner_corners": size}), m) is None
    assert pattern_seen(image) == (7, 5)
    assert pattern_seen(np.full((300, 400), 90, np.uint8)) is None


def test_turns_of_a_square_board_are_four():
    square = Board(inner_corners=(5, 5), square_m=0.1, board_m=(0.7, 0.7))
    m = model(2)
    found = find_corners(drawn(m, square, T_CAMERA_BOARD), square, m)
    assert found is not None and found.turns == 4
    poses = [found.turned(square, turn).T_camera_board for turn in range(4)]
    assert min(np.abs(T - T_CAMERA_BOARD).max() for T in poses) < 5e-3
    for turn in range(4):
        way = found.turned(square, turn)
        there, _ = project(m, transform(way.T_camera_board, square.corners_m()[way.index]))
        assert np.abs(there - way.pixels).max() < 0.5
    np.testing.assert_allclose(board_turn(1, 4) @ board_turn(3, 4), np.eye(4))


def test_markers_name_corners_of_a_board_partly_hidden():
    charuco = Charuco(dictionary="DICT_5X5_100", marker_m=0.07)
    board = BOARD.model_copy(update={"charuco": charuco})
    flat = charuco_pattern(board, charuco).generateImage((800, 600), marginSize=0)
    m = model(2)
    square = 100
    corners = np.array([(0, 0), (800, 0), (800, 600), (0, 600)], np.float32) - 0.5
    half = np.array([4, 3]) * board.square_m
    on_it = np.array(
        [(-half[0], half[1], 0), (half[0], half[1], 0), (half[0], -half[1], 0), (-half[0], -half[1], 0)]
    )
    H = cv2.getPerspectiveTransform(
        corners, project(m, transform(T_CAMERA_BOARD, on_it))[0].astype(np.float32)
    )
    image = cv2.warpPerspective(flat, H, (m.width_px, m.height_px), borderValue=200)
    image[:, 680:] = 120
    found = find_corners(image, board, m)
    assert square and found is not None
    assert 6 <= len(found.index) < 35
    true, _ = project(m, transform(T_CAMERA_BOARD, board.corners_m()))
    assert np.linalg.norm(found.pixels - true[found.index], axis=1).max() < 0.6


def test_no_image():
    assert grey(b"") is None and grey(b"no image") is None
    assert find_corners(np.full((240, 320), 80, np.uint8), BOARD, model(2)) is None


def test_bearings_of_the_rim_of_a_fisheye_are_finite():
    m = model(1)
    bearings = Bearings.of(m, np.array([[2.0, 2.0], [m.width_px - 3.0, m.height_px - 3.0]]))
    assert np.isfinite(bearings.slopes).all()


@pytest.mark.parametrize("side", ["first", "last", "left", "both"])
def test_ends_of_squares_are_no_row_of_corners(side):
    m = model(2)
    image = drawn(m, BOARD, T_CAMERA_BOARD)
    x = np.arange(-1, 8)[:, None] - 3.0
    y = np.arange(-1, 6)[None, :] - 2.0
    every = np.stack(np.broadcast_arrays(0.095 * x, 0.095 * y, 0.0 * x), axis=-1)
    pixels = project(m, transform(T_CAMERA_BOARD, every.reshape(-1, 3)))[0].reshape(9, 7, 2)
    right = pixels[1:8, 1:6]
    wide = {
        "first": pixels[:8, 1:6],
        "last": pixels[1:, 1:6],
        "left": pixels[1:8, :6],
        "both": pixels[:, 1:6],
    }
    found = pattern_in(image, wide[side], 7, 5)
    assert found is not None
    np.testing.assert_allclose(found, right)
    turned = pattern_in(image, wide[side].transpose(1, 0, 2), 7, 5)
    assert turned is not None
    assert sorted(map(tuple, turned.reshape(-1, 2))) == sorted(map(tuple, right.reshape(-1, 2)))


def test_part_of_a_larger_pattern_is_not_taken():
    m = model(2)
    image = drawn(m, BOARD, T_CAMERA_BOARD)
    pixels = project(m, transform(T_CAMERA_BOARD, BOARD.corners_m()))[0].reshape(7, 5, 2)
    assert pattern_in(image, pixels, 6, 5) is None
    assert pattern_in(image, pixels, 7, 4) is None
    assert pattern_in(image, pixels, 4, 5) is None
    assert pattern_in(image, pixels[:5], 7, 5) is None
