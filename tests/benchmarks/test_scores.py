"""Scores of trajectories that are wrong by a known amount."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks import scores
from benchmarks.systems import Outcome
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.se3 import F8, pose, se3_exp, so3_exp

START_NS = 1_700_000_000_000_000_000
STEP_M = 1.0


def path(count: int, scale: float = 1.0) -> F8:
    """A straight drive at 10 m/s, ten poses per second."""
    x = scale * STEP_M * np.arange(count)
    return pose(np.eye(3), np.column_stack((x, 0 * x, 0 * x)))


def stamps(count: int, late_ns: int = 0) -> np.ndarray:
    return START_NS + late_ns + 100_000_000 * np.arange(count)


def outcome(T: F8, late_ns: int = 0, **extra: np.ndarray) -> Outcome:
    n = len(T)
    return Outcome(stamps(n, late_ns), T, np.arange(1.0, n + 1), 100.0, 2, extra)


def truth(count: int) -> Truth:
    return Truth(stamps(count), path(count), "exact")


def values(found) -> dict[str, float]:
    return {score.name: score.value for score in found}


def test_a_scale_error_of_one_per_cent_is_one_per_cent() -> None:
    said = values(scores.accuracy(truth(160), outcome(path(160, 1.01)), 160))
    # a segment ends at the first pose beyond the length: 10 m of path are 11 steps of 1 m
    assert said["rpe10_m"] == pytest.approx(0.11, rel=1e-6)
    assert said["rpe1_m"] == pytest.approx(0.02, rel=1e-6)
    assert said["kitti_t_rel_percent"] == pytest.approx(1.01, rel=1e-3)
    assert said["kitti_r_rel_deg_per_100m"] == pytest.approx(0.0, abs=1e-6)
    assert said["lost_scans"] == 0


def test_poses_that_hold_for_another_instant_are_compared_there() -> None:
    """At the end of a sweep the vehicle is half a metre farther than in its middle."""
    turn = pose(so3_exp([0.0, 0.0, 0.3]), [5.0, -2.0, 1.0])  # another frame changes nothing either
    late = outcome(turn @ path(60), late_ns=50_000_000)
    late = dataclasses.replace(late, T=late.T @ pose(np.eye(3), [0.5, 0.0, 0.0]))
    said = values(scores.accuracy(truth(60), late, 60))
    assert said["rpe5_m"] == pytest.approx(0.0, abs=1e-9)
    assert said["ate_m"] == pytest.approx(0.0, abs=1e-9)


def test_a_short_path_has_no_kitti_figures() -> None:
    said = values(scores.accuracy(truth(90), outcome(path(90)), 90))
    assert "kitti_t_rel_percent" not in said
    assert said["rpe20_m"] == pytest.approx(0.0, abs=1e-9)


def test_who_loses_track_has_no_accuracy() -> None:
    said = values(scores.accuracy(truth(90), outcome(path(40)), 90))
    assert said == {"lost_scans": 50}


def test_nees_of_errors_drawn_from_the_covariance_is_six() -> None:
    rng = np.random.default_rng(4)
    std = np.array([0.01, 0.02, 0.005, 0.1, 0.05, 0.2])
    n = 2000
    T = [np.eye(4)]
    for xi in std * rng.standard_normal((n - 1, 6)):
        T.append(T[-1] @ pose(np.eye(3), [STEP_M, 0.0, 0.0]) @ se3_exp(xi))
    covariance = np.tile(np.diag(std**2), (n, 1, 1))
    squares = scores.nees(truth(n), outcome(np.array(T), covariance=covariance))
    assert len(squares) == n - 1
    assert 5.6 < squares.mean() < 6.4  # 3.5 standard deviations of the mean
    assert 5.0 < np.median(squares) < 5.7


def test_cost_is_median_and_tail() -> None:
    said = values(scores.cost(outcome(path(100))))
    assert said["ms_per_frame"] == pytest.approx(50.5)
    assert said["ms_per_frame_p95"] == pytest.approx(95.05)
    assert said["threads"] == 2
    assert said["peak_rss_mb"] == 100.0
