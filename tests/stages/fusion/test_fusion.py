"""Fusion against known truth, with two-sided bounds: too good is as suspicious as too bad."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.rig import ImuCheck, SensorCheck
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.fusion import Settings, fusion
from scanloom.stages.geometry.geodesy import geodetic_to_world
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, so3_exp
from tests.stages.fusion.drives import (
    ORIGIN,
    World,
    ate,
    gnss_at,
    gnss_of,
    imu_of,
    loops_of,
    odometry_of,
    parts,
    rectangle,
    session_of,
)

WORLD = rectangle()
ODOMETRY = odometry_of(WORLD)
NO_LOOPS = loops_of([])


def fuse(
    gnss: Gnss,
    loops: Loops = NO_LOOPS,
    imu: Imu | None = None,
    odometry: Odometry = ODOMETRY,
    world: World = WORLD,
    wheel: Wheel | None = None,
    settings: Settings | None = None,
) -> tuple[Poses, Graph]:
    imu = imu_of(world) if imu is None else imu
    out = list(
        fusion(
            settings or Settings(),
            parts(a=session_of("a", world)),
            parts(a=odometry),
            loops,
            parts(a=gnss),
            parts(a=imu),
            None if wheel is None else parts(a=wheel),
        )
    )
    return out[0].product, out[1]


def in_truth_frame(poses: Poses) -> np.ndarray:
    """Poses moved from the map's world frame to the truth's (both east, north, up, a few metres apart)."""
    g = poses.georeference
    offset = geodetic_to_world(ORIGIN, g["latitude_deg"], g["longitude_deg"], g["height_m"])[0]
    return pose(np.eye(3), offset) @ poses.T_world_lidar


def verdicts(graph: Graph, kind: str) -> Counter:
    return Counter(graph.verdict[graph.kind == kind])


def true_loops(world: World = WORLD, every: int = 40, sigma: float = 0.03, seed: int = 5) -> list:
    """Loops between the laps, with noise."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(ODOMETRY.keyframe)
    path, lap = world.path, world.path[-1] / 2
    out = []
    for j in rows[path[rows] > lap + 1][:: every // 4]:
        i = rows[np.argmin(np.abs(path[rows] - (path[j] - lap)))]
        noise = se3_exp(rng.normal(0, 1, 6) * np.repeat([np.radians(0.1), sigma], 3))
        out.append(("a", int(i), "a", int(j), inverse(world.T[i]) @ world.T[j] @ noise))
    return out


def test_gnss_fixes_the_drift_in_absolute_terms() -> None:
    poses, graph = fuse(gnss_of(WORLD, sigma=0.1))
    error = ate(in_truth_frame(poses), WORLD.T, align=False)
    assert ate(ODOMETRY.T_odom_lidar, WORLD.T) > 0.8
    assert 0.01 < error < 0.12
    assert poses.frame == "world"
    assert poses.georeference["epsg"] == 32632
    assert verdicts(graph, "gnss")["used"] > 50
    assert len(poses) == len(WORLD.T)


def test_covariances_tell_the_error() -> None:
    errors, sigmas = [], []
    for seed in range(4):
        poses, _ = fuse(gnss_of(WORLD, sigma=0.15, seed=seed), odometry=odometry_of(WORLD, seed=seed))
        errors.append(in_truth_frame(poses)[:, :3, 3] - WORLD.T[:, :3, 3])
        sigmas.append(np.sqrt(np.diagonal(poses.covariance, axis1=1, axis2=2))[:, 3:])
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(sigmas)))
    assert 0.2 < ratio < 1.2


def test_lever_arm_matters_and_is_used() -> None:
    arm = np.array([-2.0, 1.5, 1.0])
    gnss = gnss_of(WORLD, sigma=0.05, antenna=arm)
    settings, odometry, imu = Settings(), parts(a=ODOMETRY), parts(a=imu_of(WORLD))

    def error(session: object) -> float:
        out = next(iter(fusion(settings, parts(a=session), odometry, NO_LOOPS, parts(a=gnss), imu)))
        return ate(in_truth_frame(out.product), WORLD.T, align=False)

    assert 0.01 < error(session_of("a", WORLD, antenna=arm)) < 0.12
    assert error(session_of("a", WORLD, antenna=np.zeros(3))) > 1.0


def test_multipath_with_a_good_status_is_seen() -> None:
    gnss = gnss_of(WORLD, sigma=0.1)
    path = np.interp(gnss.stamp_ns, WORLD.stamp_ns, WORLD.path)
    lie = (path > 180) & (path < 260)
    world = geodetic_to_world(ORIGIN, gnss.latitude_deg, gnss.longitude_deg, gnss.height_m)
    world[lie] += np.array([2.4, -1.8, 2.0])
    poses, graph = fuse(gnss_at(gnss.stamp_ns, world, 0.1))
    rows = graph.kind == "gnss"
    used = graph.verdict[rows] == "used"
    assert used[lie].sum() == 0
    assert used[~lie].sum() > 35
    assert 0.01 < ate(in_truth_frame(poses), WORLD.T, align=False) < 0.25


def test_receiver_gates_and_recovery() -> None:
    gnss = gnss_of(WORLD)
    n = len(gnss)
    status, covariance = gnss.status.copy(), gnss.covariance_m2.copy()
    status[100:130] = -1
    covariance[200:210] *= 1e4
    poses, graph = fuse(Gnss(**{**vars(gnss), "status": status, "covariance_m2": covariance}))
    verdict = graph.verdict[graph.kind == "gnss"]
    assert len(verdict) == n
    assert set(verdict[100:130]) == {"receiver reports no fix"}
    assert set(verdict[130:155]) == {"recovering after an outage"}
    assert "used" in set(verdict[155:200])
    assert set(verdict[200:210]) == {"receiver's standard deviation too large"}
    assert ate(in_truth_frame(poses), WORLD.T, align=False) < 0.3


def test_loops_alone_close_the_map() -> None:
    poses, graph = fuse(Gnss.empty(), loops_of(true_loops()))
    assert poses.frame == "map"
    assert poses.georeference is None
    assert verdicts(graph, "loop") == {"used": len(true_loops())}
    before, after = ate(ODOMETRY.T_odom_lidar, WORLD.T), ate(poses.T_world_lidar, WORLD.T)
    assert 0.005 < after < 0.6 * before


def test_false_loops_are_switched_off() -> None:
    false = [("a", 0, "a", int(np.flatnonzero(ODOMETRY.keyframe)[k]), np.eye(4)) for k in (60, 100, 150)]
    honest, _ = fuse(Gnss.empty(), loops_of(true_loops()))
    poses, graph = fuse(Gnss.empty(), loops_of(true_loops() + false))
    verdict = graph.verdict[graph.kind == "loop"]
    assert all(v == "used" for v in verdict[:-3])
    assert all(v != "used" for v in verdict[-3:])
    assert np.all(graph.weight[graph.kind == "loop"][-3:] == 0)
    assert np.abs(poses.T_world_lidar - honest.T_world_lidar).max() < 0.01


def test_without_any_help_the_trajectory_is_odometry_made_level() -> None:
    tilt = pose(so3_exp([0.05, -0.08, 0.0]), np.zeros(3))
    tilted = World(WORLD.T @ tilt, WORLD.stamp_ns)
    poses, graph = fuse(Gnss.empty(), imu=imu_of(tilted), odometry=odometry_of(tilted), world=tilted)
    assert poses.frame == "map"
    up_error = np.degrees(
        np.arccos(np.clip((poses.T_world_lidar[:, :3, :3] @ tilt[:3, :3].T)[:, 2, 2], -1, 1))
    )
    assert 0.0 < up_error.max() < 1.5
    assert verdicts(graph, "gravity")["used"] > 20
    assert set(graph.kind) == {"odometry", "gravity", "prior"}


def test_level_assumption_without_imu() -> None:
    poses, graph = fuse(gnss_of(WORLD), imu=Imu.empty())
    assert poses.frame == "world"
    assert 0.01 < ate(in_truth_frame(poses), WORLD.T, align=False) < 0.2
    assert (graph.kind == "gravity").sum() == 1


def test_imu_is_read_as_the_check_of_the_sensors_says() -> None:
    """In g and with its axes permuted: no gravity to be believed until both are put right."""
    imu = imu_of(WORLD)
    odd = dataclasses.replace(imu, accel_m_s2=imu.accel_m_s2[:, [2, 0, 1]] / 9.81)
    axes = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    right = SensorCheck(imu=ImuCheck(verdict="corrected", accel_factor=9.81, accel_axes=axes, gyro_axes=axes))

    def gravity_factors(check: SensorCheck) -> int:
        given = (
            parts(a=session_of("a", WORLD)),
            parts(a=ODOMETRY),
            NO_LOOPS,
            parts(a=gnss_of(WORLD)),
            parts(a=odd),
        )
        *_, graph = fusion(Settings(), *given, check=parts(a=check))
        assert isinstance(graph, Graph)
        return int((graph.kind == "gravity").sum())

    assert gravity_factors(right) > 10
    assert gravity_factors(SensorCheck()) == 1


def test_imu_mounted_on_its_side_is_not_believed() -> None:
    imu = imu_of(WORLD)
    sideways = Imu(
        stamp_ns=imu.stamp_ns, gyro_rad_s=imu.gyro_rad_s, accel_m_s2=imu.accel_m_s2[:, [2, 0, 1]].copy()
    )
    poses, graph = fuse(gnss_of(WORLD), imu=sideways)
    assert (graph.kind == "gravity").sum() == 1
    assert ate(in_truth_frame(poses), WORLD.T, align=False) < 0.2


def test_gnss_too_short_for_a_heading_falls_back_to_map() -> None:
    gnss = gnss_of(WORLD, sigma=1.0).take(slice(0, 4))
    poses, graph = fuse(gnss)
    assert poses.frame == "map"
    reasons = set(graph.verdict[graph.kind == "gnss"])
    assert len(reasons) == 1
    assert "heading" in reasons.pop()


def test_noisy_heights_do_not_twist_a_short_drive() -> None:
    short = World(WORLD.T[:100], WORLD.stamp_ns[:100])
    odometry = ODOMETRY.take(slice(0, 100))
    gnss = gnss_of(short, sigma=0.4, every=1)
    poses, _ = fuse(gnss, imu=imu_of(short), odometry=odometry, world=short)
    assert poses.frame == "world"
    up_error = np.degrees(np.arccos(np.clip(poses.T_world_lidar[:, 2, 2], -1, 1)))
    assert up_error.max() < 2.0
    assert 0.0 < ate(poses.T_world_lidar, short.T) < 0.4


def test_two_sessions_share_a_map_through_loops() -> None:
    other = World(WORLD.T[100:400], WORLD.stamp_ns[100:400] + 86_400_000_000_000)
    track = odometry_of(other, seed=9)
    key_a, key_b = np.flatnonzero(ODOMETRY.keyframe), np.flatnonzero(track.keyframe)
    entries = []
    for j in key_b[::12]:
        i = key_a[np.argmin(np.linalg.norm(WORLD.T[key_a, :3, 3] - other.T[j, :3, 3], axis=1))]
        entries.append(("a", int(i), "b", int(j), inverse(WORLD.T[i]) @ other.T[j]))
    sessions = parts(a=session_of("a", WORLD), b=session_of("b", other))
    tracks, gnss = parts(a=ODOMETRY, b=track), parts(a=gnss_of(WORLD), b=Gnss.empty())
    imu = parts(a=imu_of(WORLD), b=imu_of(other))
    out = list(fusion(Settings(), sessions, tracks, loops_of(entries), gnss, imu))
    assert [p.key for p in out[:2]] == ["a", "b"]
    assert out[1].product.frame == "world"
    assert 0.01 < ate(in_truth_frame(out[1].product), other.T, align=False) < 0.25
    *kept, graph = fusion(Settings(), sessions, tracks, NO_LOOPS, gnss, imu)
    assert [part.key for part in kept] == ["a"], "what nothing ties to a map that has a place is left out"
    assert any("session b" in warning for warning in graph.warnings)
    nowhere = parts(a=Gnss.empty(), b=Gnss.empty())
    with pytest.raises(StageError, match="session"):
        list(fusion(Settings(), sessions, tracks, NO_LOOPS, nowhere, imu))


def test_same_input_same_bytes() -> None:
    runs = [fuse(gnss_of(WORLD), loops_of(true_loops())) for _ in range(2)]
    for name in ("T_world_lidar", "covariance"):
        assert getattr(runs[0][0], name).tobytes() == getattr(runs[1][0], name).tobytes()
    assert runs[0][1].residual_after.tobytes() == runs[1][1].residual_after.tobytes()


def test_empty_odometry_is_a_clear_error() -> None:
    with pytest.raises(StageError, match="odometry"):
        fuse(Gnss.empty(), odometry=Odometry.empty())


def test_a_single_scan_has_a_pose() -> None:
    one = World(WORLD.T[:1], WORLD.stamp_ns[:1])
    poses, _ = fuse(Gnss.empty(), imu=Imu.empty(), odometry=ODOMETRY.take(slice(0, 1)), world=one)
    assert len(poses) == 1
    assert np.isfinite(poses.T_world_lidar).all()
