"""Synthetic drives with known truth: drifting odometry, GNSS with lever arm, IMU, loops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.schemas.loops import Loops
from scanloom.schemas.product import Parts
from scanloom.schemas.session import Extrinsic, Session
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.geodesy import georeference, world_to_geodetic
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, so3_exp, so3_log

ORIGIN = georeference(49.011, 8.4228, 112.0)
START_NS = 1_700_000_000_000_000_000
ANTENNA = np.array([-0.8, 0.3, 1.0])


@dataclass
class World:
    """Truth (n, 4, 4) of the LiDAR in ENU at ORIGIN, one scan per 0.1 s."""

    T: np.ndarray
    stamp_ns: np.ndarray

    @property
    def path(self) -> np.ndarray:
        return np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(self.T[:, :3, 3], axis=0), axis=1))))


def rectangle(
    laps: float = 2.0, a: float = 60.0, b: float = 40.0, speed: float = 8.0, start_ns: int = START_NS
) -> World:
    """Laps around a rectangle with rounded corners, heading north-east at first, 2 m of hill."""
    radius = 8.0
    legs = [
        ("s", a),
        ("t", np.pi / 2),
        ("s", b),
        ("t", np.pi / 2),
        ("s", a),
        ("t", np.pi / 2),
        ("s", b),
        ("t", np.pi / 2),
    ]
    lap = sum(v if kind == "s" else v * radius for kind, v in legs)
    s = np.arange(0, laps * lap, speed * 0.1)
    fine = np.arange(0, laps * lap + 1, 0.05)
    edges = np.concatenate(([0], np.cumsum([v if k == "s" else v * radius for k, v in legs])))
    which = np.clip(np.searchsorted(edges, fine % lap, side="right") - 1, 0, 7)
    rate = np.where(np.array([k == "t" for k, _ in legs])[which], 1 / radius, 0.0)
    yaw = 0.7 + np.concatenate(([0], np.cumsum(rate[:-1] * 0.05)))
    x = np.concatenate(([0], np.cumsum(np.cos(yaw[:-1]) * 0.05)))
    y = np.concatenate(([0], np.cumsum(np.sin(yaw[:-1]) * 0.05)))
    z = 2.0 * np.sin(2 * np.pi * fine / lap)
    yaw_s, xyz = np.interp(s, fine, yaw), np.column_stack([np.interp(s, fine, c) for c in (x, y, z)])
    T = pose(so3_exp(np.column_stack((0 * s, 0 * s, yaw_s))), xyz + np.array([5.0, -3.0, 1.7]))
    return World(T, start_ns + (np.arange(len(s)) * 100_000_000).astype(np.int64))


def odometry_of(
    world: World, seed: int = 0, yaw_drift_deg_per_100m: float = 1.0, sigma_t: float = 0.005
) -> Odometry:
    """Relative motions with noise and a steady yaw error; frame `odom` at the first scan."""
    rng = np.random.default_rng(seed)
    motion = inverse(world.T[:-1]) @ world.T[1:]
    step = np.linalg.norm(motion[:, :3, 3], axis=1)
    noise = np.zeros((len(motion), 6))
    noise[:, :3] = rng.normal(0, np.radians(0.01), (len(motion), 3))
    noise[:, 2] += np.radians(yaw_drift_deg_per_100m) * step / 100
    noise[:, 3:] = rng.normal(0, sigma_t, (len(motion), 3))
    T = [np.eye(4)]
    for m in motion @ se3_exp(noise):
        T.append(T[-1] @ m)
    n = len(T)
    covariance = np.broadcast_to(np.diag(np.repeat([np.radians(0.01), sigma_t], 3) ** 2), (n, 6, 6)).copy()
    travelled = world.path
    keyframe = np.concatenate(([True], np.diff(np.floor(travelled / 2.0)) > 0))
    return Odometry(
        scan_index=np.arange(n), stamp_ns=world.stamp_ns, T_odom_lidar=np.array(T), covariance=covariance,
        inlier_ratio=np.ones(n), rmse_m=np.full(n, 0.03), degeneracy_d=np.ones(n), degeneracy_e=np.full(n, 0.01),
        direction_p=np.ones((n, 6)), weak_directions=np.broadcast_to(np.eye(6), (n, 6, 6)).copy(), keyframe=keyframe,
        reliable=np.ones(n, bool), segment=np.zeros(n, np.int32),
    )  # fmt: skip


def gnss_of(
    world: World, sigma: float = 0.1, seed: int = 1, every: int = 2, antenna: np.ndarray = ANTENNA
) -> Gnss:
    """Fixes of the antenna with white noise, twice as large upwards."""
    rng = np.random.default_rng(seed)
    T = world.T[::every]
    at = T[:, :3, :3] @ antenna + T[:, :3, 3] + rng.normal(0, 1, (len(T), 3)) * [sigma, sigma, 2 * sigma]
    return gnss_at(world.stamp_ns[::every], at, sigma)


def gnss_at(stamp_ns: np.ndarray, position: np.ndarray, sigma: float) -> Gnss:
    geodetic = world_to_geodetic(ORIGIN, position)
    n = len(position)
    return Gnss(
        stamp_ns=stamp_ns.copy(), latitude_deg=geodetic[:, 0].copy(), longitude_deg=geodetic[:, 1].copy(),
        height_m=geodetic[:, 2].copy(),
        covariance_m2=np.broadcast_to(np.diag([sigma, sigma, 2 * sigma]) ** 2, (n, 3, 3)).copy(),
        status=np.full(n, 2, np.int8), satellites=np.full(n, -1, np.int16),
    )  # fmt: skip


def imu_of(world: World, seed: int = 2, sigma: float = 0.05, T_lidar_imu: np.ndarray | None = None) -> Imu:
    """Specific force at scan times by second differences of truth."""
    T = world.T @ (np.eye(4) if T_lidar_imu is None else T_lidar_imu)
    a = np.gradient(np.gradient(T[:, :3, 3], 0.1, axis=0), 0.1, axis=0) + np.array([0, 0, 9.81])
    f = np.einsum("nji,nj->ni", T[:, :3, :3], a)
    rng = np.random.default_rng(seed)
    return Imu(
        stamp_ns=world.stamp_ns,
        gyro_rad_s=np.zeros((len(T), 3)),
        accel_m_s2=f + rng.normal(0, sigma, f.shape),
    )


def sensors_of(
    world: World, scale: float = 1.0, bias: tuple[float, float, float] = (0.002, -0.001, 0.01)
) -> tuple[Imu, Wheel]:
    """Gyro and wheel speed at 50 Hz of a base that is the LiDAR moved by (0.5, 0, 1.7), with noise."""
    rng = np.random.default_rng(0)
    stamp = np.arange(world.stamp_ns[0], world.stamp_ns[-1], 20_000_000)
    base = world.T.copy()
    base[:, :3, 3] -= np.einsum("nij,j->ni", world.T[:, :3, :3], np.array([0.5, 0, 1.7]))
    T = interpolate_poses(world.stamp_ns, base, np.append(stamp, stamp[-1] + 20_000_000))
    motion = inverse(T[:-1]) @ T[1:]
    rate = so3_log(motion[:, :3, :3]) / 0.02 + np.array(bias) + rng.normal(0, 0.002, (len(stamp), 3))
    speed = motion[:, 0, 3] / 0.02 / scale + rng.normal(0, 0.02, len(stamp))
    imu = Imu(stamp_ns=stamp + 10_000_000, gyro_rad_s=rate, accel_m_s2=np.tile([0, 0, 9.81], (len(stamp), 1)))
    return imu, Wheel(
        stamp_ns=stamp + 10_000_000, speed_m_s=speed, yaw_rate_rad_s=np.full(len(stamp), np.nan)
    )


def session_of(name: str, world: World, antenna: np.ndarray = ANTENNA) -> Session:
    def extrinsic(sensor: str, t: np.ndarray) -> Extrinsic:
        return Extrinsic(
            sensor=sensor, T_base_sensor=tuple(map(tuple, pose(np.eye(3), t).tolist())), source="test"
        )

    return Session(
        name=name, format="mcap", start_ns=int(world.stamp_ns[0]), end_ns=int(world.stamp_ns[-1]),
        scan_count=len(world.T), point_count=0, scan_rate_hz=10.0, beams=32, point_time="per point", topics=(),
        extrinsics=(extrinsic("lidar", np.array([0.5, 0, 1.7])), extrinsic("gnss", np.array([0.5, 0, 1.7]) + antenna)),
        problems=(), complete=True,
    )  # fmt: skip


def loops_of(entries: list[tuple[str, int, str, int, np.ndarray]], sigma_m: float = 0.05) -> Loops:
    n = len(entries)
    covariance = np.diag(np.repeat([np.radians(0.2), sigma_m], 3) ** 2)
    return Loops(
        session_i=np.array([e[0] for e in entries], object), scan_i=np.array([e[1] for e in entries], np.int64),
        session_j=np.array([e[2] for e in entries], object), scan_j=np.array([e[3] for e in entries], np.int64),
        T_i_j=np.array([e[4] for e in entries], float).reshape(-1, 4, 4),
        covariance=np.broadcast_to(covariance, (n, 6, 6)).copy(), descriptor_distance=np.zeros(n),
        inlier_ratio=np.ones(n), rmse_m=np.zeros(n), overlap=np.ones(n),
        source=np.full(n, "position", object), temporal_distance=np.full(n, np.nan), segment_distance=np.full(n, np.nan),
        seen_through=np.zeros(n), e1_m=np.zeros(n), rival=np.zeros(n), accepted=np.ones(n, bool),
        reason=np.full(n, "", object),
    )  # fmt: skip


def parts(**products: object) -> Parts:
    return Parts([((("session", name),), product) for name, product in products.items()])


def ate(estimate: np.ndarray, truth: np.ndarray, align: bool = True) -> float:
    """Root mean square position error, m, after a rigid fit unless told otherwise."""
    a, b = estimate[:, :3, 3], truth[:, :3, 3]
    if align:
        ca, cb = a - a.mean(0), b - b.mean(0)
        U, _, Vt = np.linalg.svd(ca.T @ cb)
        R = (U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt).T
        a = ca @ R.T + b.mean(0)
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))
