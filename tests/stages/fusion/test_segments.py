"""A session in two segments: nothing told odometry the motion in between, loops between the segments do."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import inverse, se3_exp
from tests.stages.fusion.drives import ate, gnss_of, loops_of, sensors_of
from tests.stages.fusion.test_fusion import ODOMETRY, WORLD, fuse, in_truth_frame, true_loops

BREAK = np.array([0.1, -0.05, 0.5, 4.0, -3.0, 0.5])
"""Error of the guessed motion: 29 degrees and 5 m."""


def broken(at: int) -> Odometry:
    """Odometry with a wrong guess at row `at`, said to be one."""
    T, segment, keyframe = ODOMETRY.T_odom_lidar.copy(), ODOMETRY.segment.copy(), ODOMETRY.keyframe.copy()
    covariance, reliable = ODOMETRY.covariance.copy(), ODOMETRY.reliable.copy()
    T[at:] = T[at - 1] @ se3_exp(BREAK) @ inverse(T[at - 1]) @ T[at:]
    segment[at:], reliable[at], keyframe[at - 1 : at + 1] = 1, False, True
    covariance[at] = np.diag([1.0] * 3 + [10.0**2] * 3)
    return dataclasses.replace(
        ODOMETRY, T_odom_lidar=T, segment=segment, reliable=reliable, keyframe=keyframe, covariance=covariance
    )


@pytest.mark.parametrize("share", [0.4, 0.75])
def test_loops_join_the_segments(share: float) -> None:
    at = int(share * len(WORLD.T))
    odometry = broken(at)
    assert ate(odometry.T_odom_lidar, WORLD.T) > 2.0
    poses, graph = fuse(Gnss.empty(), loops_of(true_loops()), odometry=odometry)
    assert 0.01 < ate(poses.T_world_lidar, WORLD.T) < 0.3
    jump = inverse(poses.T_world_lidar[at - 1]) @ poses.T_world_lidar[at]
    true = inverse(WORLD.T[at - 1]) @ WORLD.T[at]
    assert np.linalg.norm((jump - true)[:3, 3]) < 0.3, "no scan is smeared over the unknown motion"
    assert (graph.verdict[graph.kind == "loop"] == "used").mean() > 0.9


def test_gnss_places_each_segment_by_itself() -> None:
    at = len(WORLD.T) // 2
    poses, graph = fuse(gnss_of(WORLD, sigma=0.1), odometry=broken(at))
    assert 0.01 < ate(in_truth_frame(poses), WORLD.T, align=False) < 0.2
    assert np.array_equal(poses.scan_index, ODOMETRY.scan_index), (
        "one table per session, in the order of the scans"
    )
    used = graph.verdict[graph.kind == "gnss"] == "used"
    assert used.sum() > 50
    assert len(used) == len(gnss_of(WORLD).stamp_ns), "every fix has one factor"
    assert graph.warnings == []


def test_wheels_bridge_the_gap_where_nothing_else_does() -> None:
    at = len(WORLD.T) // 2
    imu, wheel = sensors_of(WORLD)
    poses, graph = fuse(Gnss.empty(), imu=imu, odometry=broken(at), wheel=wheel)
    jump = inverse(poses.T_world_lidar[at - 1]) @ poses.T_world_lidar[at]
    true = inverse(WORLD.T[at - 1]) @ WORLD.T[at]
    assert np.linalg.norm((jump - true)[:3, 3]) < 0.2
    assert graph.warnings == []


def test_a_guess_is_called_one() -> None:
    poses, graph = fuse(Gnss.empty(), odometry=broken(len(WORLD.T) // 2))
    assert len(poses) == len(WORLD.T)
    (warning,) = graph.warnings
    assert "is a guess" in warning
    assert "session a" in warning


def test_a_segment_of_one_scan_keeps_its_place() -> None:
    at = len(WORLD.T) // 2
    odometry = broken(at)
    segment, keyframe = odometry.segment.copy(), odometry.keyframe.copy()
    segment[at + 1 :], keyframe[at + 1] = 2, True
    poses, _ = fuse(
        gnss_of(WORLD, sigma=0.1), odometry=dataclasses.replace(odometry, segment=segment, keyframe=keyframe)
    )
    assert 0.01 < ate(in_truth_frame(poses), WORLD.T, align=False) < 0.2
