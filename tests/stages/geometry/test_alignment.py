"""Alignment of trajectories: known motions and drifts come out as they went in."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.alignment import (
    absolute_errors,
    errors_from_start,
    kitti_errors,
    relative_errors,
    travelled,
    umeyama,
)
from scanloom.stages.geometry.se3 import inverse, pose, so3_exp, transform
from tests.stages.mapping import circle, drifting


def test_umeyama_finds_the_motion_even_of_flat_and_mirrored_clouds() -> None:
    rng = np.random.default_rng(0)
    T = pose(so3_exp([0.4, -2.0, 1.0]), [5, -3, 2])
    for scale in ([1, 1, 1], [1, 1, 0]):
        points = rng.normal(size=(50, 3)) * scale
        assert np.abs(umeyama(transform(T, points), points) - T).max() < 1e-12
    found = umeyama(rng.normal(size=(3, 3)) * [-1, 1, 1], rng.normal(size=(3, 3)))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_umeyama_of_noisy_points_is_as_good_as_the_noise_allows() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(0, 10, (2000, 3))
    T = pose(so3_exp([0.1, 0.2, -0.3]), [1, 2, 3])
    found = umeyama(transform(T, points) + rng.normal(0, 0.1, points.shape), points)
    error = np.linalg.norm((inverse(T) @ found)[:3, 3])
    assert 0.0002 < error < 0.02


def test_a_moved_trajectory_has_no_error_and_a_longer_one_has() -> None:
    T = circle()
    moved = pose(so3_exp([0.3, 0.1, 2.0]), [100, -50, 3]) @ T
    assert absolute_errors(T, moved).max() < 1e-9
    assert errors_from_start(T, moved).max() < 1e-9
    grown = T.copy()
    grown[:, :3, 3] *= 1.01
    assert np.allclose(absolute_errors(T, grown), 0.8, atol=0.1)  # one per cent of the radius


def test_kitti_drift_is_the_scale_error_of_a_straight_road() -> None:
    T = circle(1500, radius_m=1e9)
    drift = kitti_errors(T, drifting(T, scale=1.013))
    assert drift is not None
    assert drift.t_rel_percent == pytest.approx(1.3, abs=0.02)
    assert drift.r_rel_deg_per_100m < 1e-4


def test_kitti_rotation_drift_is_the_yaw_rate() -> None:
    T = circle(900)
    drift = kitti_errors(T, drifting(T, yaw_rate_rad_m=np.radians(0.5) / 100))
    assert drift is not None
    assert drift.r_rel_deg_per_100m == pytest.approx(0.5, rel=0.02)


def test_kitti_segments_are_those_of_the_benchmark() -> None:
    """By a plain loop, as `evaluate_odometry.cpp` has it."""
    T, estimate = circle(450, step_m=0.9), drifting(circle(450, step_m=0.9), 1.01, noise_m=0.02)
    path = travelled(T)
    errors = []
    for first in range(0, len(T), 10):
        for length in range(100, 801, 100):
            last = next((i for i in range(first, len(T)) if path[i] > path[first] + length), None)
            if last is not None:
                motion = inverse(estimate[first]) @ estimate[last]
                error = inverse(motion) @ (inverse(T[first]) @ T[last])
                errors.append(np.linalg.norm(error[:3, 3]) / length)
    drift = kitti_errors(T, estimate)
    assert drift is not None
    assert drift.segments == len(errors)
    assert drift.t_rel_percent == pytest.approx(100 * np.mean(errors), rel=1e-12)


def test_short_paths_have_no_kitti_drift() -> None:
    assert kitti_errors(circle(90), circle(90)) is None
    assert len(relative_errors(circle(90), circle(90), 10.5)) == 79


def test_relative_error_grows_as_white_noise_does() -> None:
    T = circle(4000)
    estimate = drifting(T, noise_m=0.02)
    short, long = (relative_errors(T, estimate, length).translation_m for length in (5.0, 20.0))
    rms = np.sqrt(np.mean(short**2))
    assert 0.8 < rms / (0.02 * np.sqrt(3 * 6)) < 1.2  # six steps: the first pose beyond 5 m
    assert 1.5 < np.sqrt(np.mean(long**2)) / rms < 2.3
