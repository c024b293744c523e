"""Derivatives of the graph's rows, and its loss."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.board_scenes import World, model, simulate
from scanloom.stages.calibrate.factors import cloud_rows, corner_rows, softened
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.rays import Bearings, board_pose, on_board
from scanloom.stages.calibrate.view import Sensor, moved, rows_of
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, so3_exp, transform


def slopes(function, size):
    h = 1e-6
    return np.stack([(function(h * e) - function(-h * e)) / (2 * h) for e in np.eye(size)], axis=-1)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.mark.parametrize("lens", [0, 1, 2])
def test_corner_rows(rng, lens):
    m = model(lens)
    bearings = Bearings.of(m, rng.uniform(200, 760, (9, 2)))
    C = se3_exp(rng.normal(size=6) * 0.3)
    B = C @ pose(so3_exp([0.3, -0.2, 0.4]), [0.2, 0.1, 2.0])
    corners = np.column_stack((rng.uniform(-0.4, 0.4, (9, 2)), np.zeros(9)))
    _, by_camera, by_board = corner_rows(C, B, corners, bearings)
    np.testing.assert_allclose(
        slopes(lambda x: corner_rows(C @ se3_exp(x), B, corners, bearings)[0], 6), by_camera, atol=1e-5
    )
    np.testing.assert_allclose(
        slopes(lambda x: corner_rows(C, B @ se3_exp(x), corners, bearings)[0], 6), by_board, atol=1e-5
    )


@pytest.mark.parametrize("turn", [0.0, 1e-5, 0.4, 2.5])
def test_cloud_rows(rng, turn):
    L = se3_exp(rng.normal(size=6))
    B = L @ pose(so3_exp(turn * np.array([0.6, 0.0, 0.8])), [0.03, -0.02, 0.01])
    error, J = cloud_rows(B, L)
    np.testing.assert_allclose(slopes(lambda x: cloud_rows(B @ se3_exp(x), L)[0], 6), J, atol=1e-7)
    np.testing.assert_allclose(moved(L, error), B, atol=1e-12)


def test_bearings_are_pixels_near_the_solution(rng):
    m = model(1)
    points = np.column_stack((rng.uniform(-1, 1, (20, 2)), rng.uniform(1.5, 3, 20)))
    pixels, _ = project(m, points)
    shifted = points + rng.normal(0, 1e-3, points.shape)
    wanted = project(m, shifted)[0] - pixels
    error, _ = Bearings.of(m, pixels).errors(shifted)
    np.testing.assert_allclose(error, wanted, atol=2e-3)


def test_softened_is_hubers_loss():
    error = np.array([[0.5, 0.0], [3.0, 4.0], [0.0, 0.0]])
    by_error, by_slope = softened(error, 2.0)
    squares = ((error * by_error) ** 2).sum(axis=1)
    np.testing.assert_allclose(squares, [0.25, 2 * 2.0 * 5.0 - 4.0, 0.0])
    assert (by_error * by_slope)[1, 0] == pytest.approx(2.0 / 5.0)
    assert by_error[0, 0] == by_slope[0, 0] == 1.0


def test_board_pose_and_back():
    m = model(0)
    corners = World().board.corners_m()
    T = pose(so3_exp([0.2, -0.3, 0.7]), [0.3, -0.1, 2.2]) @ pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    pixels, seen = project(m, transform(T, corners))
    assert seen.all()
    bearings = Bearings.of(m, pixels)
    fit = board_pose(bearings, corners)
    assert fit is not None and fit.rms_px < 1e-5
    np.testing.assert_allclose(fit.T_camera_board, T, atol=1e-6)
    np.testing.assert_allclose(on_board(inverse(T), bearings.directions), corners[:, :2], atol=1e-7)


def test_board_of_a_cloud_with_a_known_sensor_is_surer():
    scene, _ = simulate(World(cameras=1, placements=1), 0)
    view = scene.placements[0].cloud
    unknown = Sensor.unknown(scene.beams, Noise())
    known = Sensor(scene.beams, unknown.mean, 1e-6 * unknown.covariance)
    sure, unsure = (rows_of(view, s, Noise()).board(s)[1] for s in (known, unknown))
    assert np.sqrt(sure[5, 5]) < 0.3 * np.sqrt(unsure[5, 5])
    assert np.sqrt(sure[5, 5]) > 4e-4
