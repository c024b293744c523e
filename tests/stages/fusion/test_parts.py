"""The pieces of the fusion one by one: alignment, gates, covariances, anchoring."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.fusion import Settings, fusion
from scanloom.stages.fusion.agreement import longest_chain
from scanloom.stages.fusion.alignment import align_level
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.fusion.gnss_settings import GnssSettings
from scanloom.stages.fusion.receiver import receiver_sigma
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, se3_log, so3_exp
from tests.stages.fusion.drives import (
    START_NS,
    World,
    gnss_of,
    imu_of,
    loops_of,
    odometry_of,
    parts,
    rectangle,
    session_of,
)


def drive_of(odometry: Odometry, world: World) -> Drive:
    return Drive(
        "a",
        session_of("a", world),
        odometry,
        Gnss.empty(),
        Imu.empty(),
        Wheel.empty(),
        0,
        np.flatnonzero(odometry.keyframe),
    )


def test_alignment_finds_heading_and_place_among_lies() -> None:
    rng = np.random.default_rng(0)
    level = np.column_stack((np.linspace(0, 100, 60), 10 * np.sin(np.arange(60) / 9), np.zeros(60)))
    R = so3_exp([0, 0, 2.1])
    world = level @ R.T + [40, -7, 3] + rng.normal(0, 0.1, (60, 3))
    world[20:35] += [6.0, 3.0, 1.0]
    found = align_level(level, world, np.full(60, 0.2), np.linspace(0, 110, 60), drift=0.01)
    assert found is not None
    assert not found.inliers[20:35].any()
    assert found.inliers.sum() >= 40
    heading = np.arctan2(found.T_world_level[1, 0], found.T_world_level[0, 0])
    assert abs(heading - 2.1) < 0.01
    np.testing.assert_allclose(found.T_world_level[:3, 3], [40, -7, 3], atol=0.3)
    assert 1e-4 < found.heading_sigma_rad < 0.01


def test_alignment_gives_up_on_a_standing_vehicle() -> None:
    rng = np.random.default_rng(0)
    level, world = np.zeros((50, 3)), rng.normal(0, 1.0, (50, 3))
    found = align_level(level, world, np.full(50, 1.0), np.zeros(50), drift=0.04)
    assert found is None or found.heading_sigma_rad > 1.0


def test_chain_goes_around_a_stretch_that_is_off_and_follows_slow_drift() -> None:
    path = np.arange(0, 300, 5.0)
    residual = 0.02 * path + 0j
    residual[25:40] += 4.0j
    keep = longest_chain(residual, path, 0.04 * path, np.full(60, 0.05), 0.3, 400.0)
    assert keep[:25].all()
    assert not keep[25:40].any()
    assert keep[40:].all()


def test_receivers_that_give_no_covariance_get_a_guess() -> None:
    gnss = gnss_of(World(np.tile(np.eye(4), (4, 1, 1)), START_NS + np.arange(4) * 10**8), every=1)
    covariance = gnss.covariance_m2.copy()
    covariance[0], covariance[1], covariance[2, 0, 0] = 0.0, np.nan, -1.0
    sigma = receiver_sigma(GnssSettings(), Gnss(**{**vars(gnss), "covariance_m2": covariance}))
    np.testing.assert_allclose(sigma[:3], [[3, 3, 6]] * 3)
    np.testing.assert_allclose(sigma[3], [0.1, 0.1, 0.2])


def test_covariance_of_a_motion_is_carried_to_its_end() -> None:
    """Against a simulation of many noisy motions."""
    world = rectangle(laps=0.3)
    rows = np.arange(30, 61)
    motion = inverse(world.T[rows[:-1]]) @ world.T[rows[1:]]
    sigma = np.array([0.001, 0.002, 0.004, 0.02, 0.01, 0.03])
    rng = np.random.default_rng(0)
    ends = np.tile(np.eye(4), (3000, 1, 1))
    for m in motion:
        ends = ends @ m @ se3_exp(rng.normal(0, 1, (3000, 6)) * sigma)
    sampled = np.cov(se3_log(inverse(inverse(world.T[30]) @ world.T[60]) @ ends).T)
    odometry = odometry_of(world)
    odometry.T_odom_lidar[:] = world.T
    odometry.covariance[:] = np.diag(sigma**2)
    odometry.keyframe[:] = False
    odometry.keyframe[[30, 60]] = True
    drive = drive_of(odometry, world)
    _, covariance = drive.keyframe_motions(1e-9, 1e-9, drive.step_covariance())
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[0])), np.sqrt(np.diag(sampled)), rtol=0.08)


def test_pose_covariance_is_in_the_axes_of_the_lidar() -> None:
    """Driving north with a receiver that is poor in east: the uncertainty is sideways, LiDAR y."""
    n = 120
    T = pose(
        np.tile(so3_exp([0, 0, np.pi / 2]), (n, 1, 1)),
        np.column_stack((np.zeros(n), np.arange(n) * 1.0, np.zeros(n))),
    )
    world = World(T, START_NS + np.arange(n) * 10**8)
    gnss = gnss_of(world, sigma=0.05)
    covariance = np.broadcast_to(np.diag([1.0, 0.05, 0.1]) ** 2, (len(gnss), 3, 3)).copy()
    gnss = Gnss(**{**vars(gnss), "covariance_m2": covariance})
    odometry = odometry_of(world, yaw_drift_deg_per_100m=0.0)
    out = next(iter(fusion(Settings(), parts(a=session_of("a", world)), parts(a=odometry), loops_of([]), parts(a=gnss), parts(a=imu_of(world)))))  # fmt: skip
    sigma = np.sqrt(np.diagonal(out.product.covariance, axis1=1, axis2=2))[n // 2]
    assert out.product.frame == "world"
    assert 3.0 < sigma[4] / sigma[3] < 30.0


def test_loops_to_unknown_scans_and_sessions_are_named() -> None:
    world = rectangle(laps=0.5)
    odometry = odometry_of(world)
    for entry, word in (
        (("a", 0, "b", 10, np.eye(4)), "session b"),
        (("a", 0, "a", 99999, np.eye(4)), "99999"),
    ):
        with pytest.raises(StageError, match=word):
            list(fusion(Settings(), parts(a=session_of("a", world)), parts(a=odometry), loops_of([entry]), parts(a=Gnss.empty()), parts(a=Imu.empty())))  # fmt: skip


def test_every_scan_lies_between_its_keyframes() -> None:
    world = rectangle(laps=0.5)
    odometry = odometry_of(world)
    out = next(iter(fusion(Settings(), parts(a=session_of("a", world)), parts(a=odometry), loops_of([]), parts(a=gnss_of(world)), parts(a=imu_of(world)))))  # fmt: skip
    T = out.product.T_world_lidar
    step, odometry_step = (inverse(a[:-1]) @ a[1:] for a in (T, odometry.T_odom_lidar))
    assert np.abs(step - odometry_step)[:, :3, 3].max() < 0.05
    np.testing.assert_allclose(
        T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-9
    )
    np.testing.assert_array_equal(out.product.keyframe, odometry.keyframe)
