"""Deskew's own figures: the input is distorted indeed, and what comes out is scored right."""

from __future__ import annotations

import numpy as np

from benchmarks.walls import START_NS, WALL_Y_M, scores, sensors, sweep_of_a_wall


def test_a_sweep_at_rest_lies_on_the_wall() -> None:
    scan = sweep_of_a_wall(np.zeros(6))
    assert len(scan) > 5000
    assert 0.004 < np.std(scan.y_m - WALL_Y_M) < 0.012
    assert abs(float(np.mean(scan.y_m)) - WALL_Y_M) < 0.001
    assert scan.reference_ns == START_NS
    assert scan.stamp_ns.max() - scan.stamp_ns.min() > 40_000_000  # almost half a sweep: the left side


def test_sensors_rest_before_they_move() -> None:
    twist = np.array([0.0, 0.0, 0.5, 20.0, 0.0, 0.0])
    imu, wheel = sensors(twist)
    rest = imu.stamp_ns < START_NS - 300_000_000
    assert abs(imu.gyro_rad_s[rest][:, 2].mean() - 0.015) < 0.001
    assert abs(imu.gyro_rad_s[~rest][-20:, 2].mean() - 0.515) < 0.003
    assert abs(wheel.speed_m_s[-10:].mean() - 20.0) < 0.05


def test_figures_of_deskew() -> None:
    said = {score.name: score.value for score in scores(None)}
    assert said["wall_raw_rms_m"] > 0.2
    assert 0.002 < said["wall_rms_m"] < 0.02
    assert said["identity_is_exact"] == 1.0
    assert "newer_range_median_m" not in said
