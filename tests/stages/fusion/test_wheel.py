"""Gyro and wheels between keyframes: scale and bias found by what scans saw, weight where they saw nothing."""

from __future__ import annotations

import dataclasses
from itertools import accumulate

import numpy as np

from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.fusion import Settings
from scanloom.stages.fusion.assembly import odometers_of
from scanloom.stages.fusion.drives import Drive, gather
from scanloom.stages.fusion.settings import WheelSettings
from scanloom.stages.fusion.wheel import Odometer, bias_at
from scanloom.stages.geometry.se3 import inverse, se3_log, so3_exp
from tests.stages.fusion.drives import START_NS, odometry_of, parts, rectangle, sensors_of, session_of
from tests.stages.fusion.test_fusion import fuse

WORLD = rectangle(laps=1.5)


def drives(odometry: Odometry, imu: Imu, wheel: Wheel) -> list[Drive]:
    session = session_of("a", WORLD)
    given = (parts(a=session), parts(a=odometry), parts(a=Gnss.empty()), parts(a=imu), parts(a=wheel))
    return list(gather(*given))


def errors(odometer: Odometer, drive: Drive) -> np.ndarray:
    """Turn and way (m, 6) by which the wheels' motions differ from truth, summed over stretches of about 20 m."""
    found = odometer.keyframe_motions(drive)
    rows = drive.keyframes
    true = inverse(WORLD.T[rows[:-1]]) @ WORLD.T[rows[1:]]
    off = se3_log(inverse(found.T) @ true[found.first])
    return np.add.reduceat(off, np.arange(0, len(off), 10))


def test_scale_and_bias_are_found_by_what_scans_saw() -> None:
    odometry = odometry_of(WORLD, yaw_drift_deg_per_100m=0.0)
    (drive,) = drives(odometry, *sensors_of(WORLD, scale=1.03))
    off = errors(Odometer(WheelSettings(), [drive]), drive)
    assert 0.01 < np.sqrt(np.mean(off[:, 3] ** 2)) < 0.15, "3 % of 20 m are 0.6 m"
    assert 1e-4 < np.sqrt(np.mean(off[:, 2] ** 2)) < 0.006, "a bias of 0.01 rad/s gives 0.025 rad in 2.5 s"


def test_bias_of_a_blind_stretch_comes_from_its_ends() -> None:
    odometry = odometry_of(WORLD, yaw_drift_deg_per_100m=0.0)
    half = len(odometry) // 2
    blind = slice(half - 60, half + 60)
    turned = odometry.T_odom_lidar.copy()
    turned[half:] = turned[half] @ so3_pose([0, 0, 0.3]) @ inverse(turned[half]) @ turned[half:]
    p = odometry.direction_p.copy()
    p[blind, 0] = 0.0
    odometry = dataclasses.replace(odometry, T_odom_lidar=turned, direction_p=p)
    (drive,) = drives(odometry, *sensors_of(WORLD))
    off = errors(Odometer(WheelSettings(), [drive]), drive)
    assert 1e-4 < np.abs(off[:, 2]).max() < 0.02, "the turn by 0.3 rad in the blind stretch is not believed"


def so3_pose(vector: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = so3_exp(vector)
    return T


def test_wheels_decide_where_no_scan_saw_the_way() -> None:
    """Odometry stands still for 6 s along x, as in a tunnel, and knows that it saw nothing along it."""
    odometry = odometry_of(WORLD, yaw_drift_deg_per_100m=0.0)
    rows = np.arange(20, 80)
    motion = inverse(odometry.T_odom_lidar[:-1]) @ odometry.T_odom_lidar[1:]
    motion[rows - 1, 0, 3] = 0.0
    T = np.array(list(accumulate([np.eye(4), *motion], np.matmul)))
    p, weak = odometry.direction_p.copy(), odometry.weak_directions.copy()
    p[rows, 0] = 0.0
    weak[rows] = np.roll(np.eye(6), 3, axis=0)
    odometry = dataclasses.replace(odometry, T_odom_lidar=T, direction_p=p, weak_directions=weak)
    imu, wheel = sensors_of(WORLD)
    lost = np.linalg.norm(WORLD.T[80, :3, 3] - WORLD.T[20, :3, 3])
    assert lost > 30.0

    def gap(settings: Settings) -> float:
        poses, graph = fuse(
            Gnss.empty(), imu=imu, odometry=odometry, world=WORLD, wheel=wheel, settings=settings
        )
        moved = inverse(poses.T_world_lidar[20]) @ poses.T_world_lidar[80]
        true = inverse(WORLD.T[20]) @ WORLD.T[80]
        assert (graph.kind == "wheel").any() == (settings.covariance == "aware")
        return float(np.linalg.norm((moved - true)[:3, 3]))

    assert 0.01 < gap(Settings()) < 1.0
    assert gap(Settings(covariance="fixed")) > 0.9 * lost


def test_logs_without_wheels_or_without_gyro_have_no_wheel_factors() -> None:
    odometry = odometry_of(WORLD)
    imu, wheel = sensors_of(WORLD)
    for given in ((imu, Wheel.empty()), (Imu.empty(), wheel), (Imu.empty(), Wheel.empty())):
        found = drives(odometry, *given)
        odometers = odometers_of(Settings(), found)
        assert all(len(o.keyframe_motions(found[0]).first) == 0 for o in odometers.values())


def test_a_bias_that_wanders_is_followed() -> None:
    rng = np.random.default_rng(1)
    stamp = START_NS + np.arange(600) * 300_000_000
    true = np.cumsum(rng.normal(0, 3e-4 * np.sqrt(0.3), (600, 3)), axis=0)
    seen = true + rng.normal(0, 2e-3, true.shape)
    found = bias_at(stamp, stamp, seen, np.full(600, 4e-6))
    assert 1e-4 < np.sqrt(np.mean((found - true) ** 2)) < 1e-3
    assert np.all(bias_at(stamp, stamp[:0], seen[:0], np.zeros(0)) == 0.0)
    np.testing.assert_allclose(bias_at(stamp, stamp[:1], seen[:1], np.ones(1)), np.tile(seen[:1], (600, 1)))


def test_one_scan_is_no_motion() -> None:
    odometry = odometry_of(WORLD).take(slice(0, 1))
    (drive,) = drives(odometry, *sensors_of(WORLD))
    assert len(Odometer(WheelSettings(), [drive]).keyframe_motions(drive).first) == 0
