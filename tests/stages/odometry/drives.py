"""Drives through analytic worlds as the products that odometry reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import F8, inverse, se3_log
from scanloom.stages.odometry import Settings, odometry
from scanloom.stages.odometry.tracking import track
from scanloom.stages.odometry.windows import windows
from tests.worlds import GROUND_Z_M, BoxWorld, drive

GYRO_BIAS_RAD_S = np.array([0.002, -0.001, 0.003])
STOOD_S = 2.0


@dataclass(frozen=True)
class Drive:
    """Scans (without labels of their own), sensors and truth (n, 4, 4)."""

    scans: list[DeskewedScan]
    truth: F8
    imu: Imu
    wheel: Wheel

    def run(self, settings: Settings | None = None, *, chunk: int = 10, sensors: bool = True) -> Odometry:
        """As a map does: in windows where the settings say so."""
        settings = settings or Settings()
        inputs = (
            parts(self.scans, chunk), parts([labelled(s) for s in self.scans], chunk), session(),
            self.imu if sensors else Imu.empty(), self.wheel if sensors else Wheel.empty(),
        )  # fmt: skip
        tracks = [track(settings, part.product, *inputs) for part in windows(settings, inputs[0])]
        return odometry(settings, *inputs, None, [t for t, _ in tracks], [ends for _, ends in tracks])


def drive_along(
    world: BoxWorld, count: int, *, step_m: float = 1.0, seed: int = 0, wheel_scale: float = 0.99
) -> Drive:
    """A straight drive at 10 Hz after two seconds of standing; wheels too slow by `wheel_scale`, gyro with bias."""
    scans, truth = drive(world, count, step_m=step_m, seed=seed, rows=24, columns=512)
    rng = np.random.default_rng(seed + 1000)
    start = scans[0].reference_ns
    imu_s, wheel_s = np.arange(-STOOD_S, 0.1 * count, 0.01), np.arange(-STOOD_S, 0.1 * count, 0.02)
    imu = Imu(
        stamp_ns=start + (imu_s * 1e9).astype(np.int64),
        gyro_rad_s=GYRO_BIAS_RAD_S + rng.normal(0, 0.002, (len(imu_s), 3)),
        accel_m_s2=np.array([0, 0, 9.81]) + rng.normal(0, 0.02, (len(imu_s), 3)),
    )
    wheel = Wheel(
        stamp_ns=start + (wheel_s * 1e9).astype(np.int64),
        speed_m_s=np.where(wheel_s < -0.05, 0.0, wheel_scale * step_m / 0.1),
        yaw_rate_rad_s=np.full(len(wheel_s), np.nan),
    )
    return Drive(scans, truth, imu, wheel)


def session() -> Session:
    return Session(
        name="a", format="mcap", start_ns=0, end_ns=1, scan_count=1, point_count=1, scan_rate_hz=10, beams=24,
        point_time="per point", topics=(), extrinsics=(), problems=(), complete=True,
    )  # fmt: skip


def labelled(scan: DeskewedScan, kind: PointClass = PointClass.STATIC) -> ScanLabels:
    return ScanLabels(
        class_=np.full(len(scan), kind, np.uint8), reference_ns=scan.reference_ns, scan_index=scan.scan_index
    )


def parts(items: list, chunk: int) -> Parts:
    kind = Deskewed if items and isinstance(items[0], DeskewedScan) else Labels
    chunks = [items[i : i + chunk] for i in range(0, len(items), chunk)]
    return Parts(((("session", "a"), ("chunk", f"{k:04d}")), kind(part)) for k, part in enumerate(chunks))


def tunnel_between_streets(length_m: float = 70.0) -> BoxWorld:
    """Blind walls and a roof from x = 25 on, with a few houses before and behind."""
    end = 25 + length_m
    walls = [
        [[25, 4, GROUND_Z_M], [end, 6, 5]],
        [[25, -6, GROUND_Z_M], [end, -4, 5]],
        [[25, -6, 3.5], [end, 6, 5]],
    ]
    closed = [[[-60, -30, GROUND_Z_M], [-58, 30, 8]], [[end + 40, -30, GROUND_Z_M], [end + 42, 30, 8]]]
    houses = [
        [[x, y, GROUND_Z_M], [x + 7, y + 5, 5]] for x in (-30, -12, 6, end + 5, end + 20) for y in (8, -14)
    ]
    return BoxWorld(np.array(walls + closed + houses, float))


def endless_tunnel() -> BoxWorld:
    walls = [
        [[-500, 4, GROUND_Z_M], [500, 6, 5]],
        [[-500, -6, GROUND_Z_M], [500, -4, 5]],
        [[-500, -6, 3.5], [500, 6, 5]],
    ]
    return BoxWorld(np.array(walls, float))


def step_errors(track: Odometry, truth: F8) -> F8:
    """Errors (n - 1, 6) of the motions between scans, right tangent."""
    wanted, found = inverse(truth[:-1]) @ truth[1:], inverse(track.T_odom_lidar[:-1]) @ track.T_odom_lidar[1:]
    return se3_log(inverse(wanted) @ found)


def end_error_m(track: Odometry, truth: F8) -> float:
    return float(np.linalg.norm((inverse(truth[0]) @ truth[-1] - track.T_odom_lidar[-1])[:3, 3]))
