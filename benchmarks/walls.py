"""Deskew alone: a flat wall seen while turning at speed, a sensor at rest, real handheld scans."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.scores import Score
from scanloom.schemas.scans import DeskewedScan, Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.deskew import Settings, deskew
from scanloom.stages.geometry.alignment import rms, umeyama
from scanloom.stages.geometry.se3 import F8, pose, se3_exp, so3_log

START_NS = 1_700_000_000_000_000_000
WALL_Y_M, SPEED_M_S, TURN_DEG_S, NOISE_M = 15.0, 20.0, 30.0, 0.01
ROWS, COLUMNS, SLICES = 32, 1024, 20
T_NEWER_IMU_LIDAR = pose(np.diag([-1.0, -1.0, 1.0]), np.array([-0.006, 0.012, -0.029]))
"""From the published points at the start of each sweep."""


def scores(newer: Path | None) -> Iterator[Score]:
    """Figures of deskew; those of real scans when their folder is there."""
    twist = np.array([0.0, 0.0, np.radians(TURN_DEG_S), SPEED_M_S, 0.0, 0.0])
    scan = sweep_of_a_wall(twist)
    (flat,) = deskew(Settings(), Scans([scan]), _session(), *sensors(twist))
    how = f"rms distance to a wall {WALL_Y_M:g} m away at {SPEED_M_S:g} m/s and {TURN_DEG_S:g} deg/s, noise {NOISE_M:g} m"
    yield Score(
        "wall_rms_m", rms(flat.y_m.astype(np.float64) - WALL_Y_M), "m", f"{how}, deskewed with gyro and wheel"
    )
    yield Score("wall_raw_rms_m", rms(scan.y_m.astype(np.float64) - WALL_Y_M), "m", f"{how}, as measured")
    same = scan.points().tobytes() == _at_rest(scan).points().tobytes()
    yield Score("identity_is_exact", float(same), "", "1 when a scan taken at rest comes out bit for bit")
    if newer is not None:
        ranges = np.concatenate([range_differences(newer, i) for i in range(3)])
        how = "of the difference in range to the points another tool published, three handheld scans"
        yield Score("newer_range_median_m", float(np.median(ranges)), "m", f"median {how}")
        yield Score("newer_range_p95_m", float(np.percentile(ranges, 95)), "m", f"95th percentile {how}")


def sweep_of_a_wall(twist: F8) -> Scan:
    """One sweep of 0.1 s about its middle, while moving with `twist`, per second, over a wall at y = WALL_Y_M."""
    rng = np.random.default_rng(5)
    azimuth = np.repeat(np.pi - 2 * np.pi * np.arange(COLUMNS) / COLUMNS, ROWS)
    elevation = np.tile(np.radians(np.linspace(-20, 10, ROWS)), COLUMNS)
    share = np.repeat(np.arange(COLUMNS) / COLUMNS, ROWS) - 0.5
    level = np.cos(elevation)
    rays = np.column_stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)))
    T = se3_exp(0.1 * share[:, None] * twist)
    towards = np.einsum("ni,ni->n", T[:, 1, :3], rays)
    seen = towards > 0.15  # less than 100 m away
    distance = ((WALL_Y_M - T[:, 1, 3]) / np.where(seen, towards, 1.0)) + NOISE_M * rng.standard_normal(
        len(rays)
    )
    points = (rays * distance[:, None])[seen]
    stamp_ns = START_NS + np.round(1e8 * share[seen]).astype(np.int64)
    return _scan(points, stamp_ns, START_NS)


def sensors(twist: F8) -> tuple[Imu, Wheel]:
    """Five seconds at rest, then the twist; gyro with bias and noise at 100 Hz, wheels at 50 Hz."""
    rng = np.random.default_rng(3)
    imu_ns = START_NS + np.arange(-520, 60) * 10_000_000
    wheel_ns = START_NS + np.arange(-260, 30) * 20_000_000
    gyro = np.where((imu_ns > START_NS - 200_000_000)[:, None], twist[:3], 0.0)
    gyro = gyro + np.array([0.01, -0.02, 0.015]) + rng.normal(0, 0.002, gyro.shape)
    accel = np.array([0, 0, 9.81]) + rng.normal(0, 0.02, gyro.shape)
    speed = np.where(wheel_ns > START_NS - 200_000_000, twist[3], 0.0) + rng.normal(0, 0.02, len(wheel_ns))
    return Imu(imu_ns, gyro, accel), Wheel(wheel_ns, speed, np.full(len(wheel_ns), np.nan))


def range_differences(folder: Path, i: int) -> F8:
    """|range deskewed - range published| (n,), m, of scan i. The motion within the sweep is read from the published
    points, as rotation in slices of the sweep, and given as a gyro: there is no log around these scans."""
    raw = np.fromfile(folder / f"raw_{i:02d}.bin", np.float32).reshape(-1, 3)
    published = np.fromfile(folder / f"deskewed_{i:02d}.bin", np.float32).reshape(-1, 3).astype(float)
    published = (published - T_NEWER_IMU_LIDAR[:3, 3]) @ T_NEWER_IMU_LIDAR[:3, :3]
    seconds = np.fromfile(folder / f"times_{i:02d}.bin", np.float32).astype(float)
    stamp_ns = START_NS + np.round(seconds * 1e9).astype(np.int64)
    scan = _scan(raw, stamp_ns, START_NS + 50_000_000)
    slot = np.minimum((seconds / seconds.max() * SLICES).astype(int), SLICES - 1)
    middle = np.array([seconds[slot == k].mean() for k in range(SLICES)])
    fits = [umeyama(published[slot == k], raw[slot == k].astype(float)) for k in range(SLICES)]
    turned = np.array([so3_log(fit[:3, :3]) for fit in fits])
    smooth = np.column_stack([np.polyval(np.polyfit(middle, turned[:, k], 2), middle) for k in range(3)])
    gyro = np.gradient(smooth, middle, axis=0)
    imu = Imu(START_NS + (middle * 1e9).astype(np.int64), gyro, np.tile([0.0, 0.0, 9.81], (SLICES, 1)))
    (flat,) = deskew(Settings(), Scans([scan]), _session(), imu, Wheel.empty())
    difference: F8 = np.abs(np.linalg.norm(flat.points(), axis=1) - np.linalg.norm(published, axis=1))
    return difference


def _at_rest(scan: Scan) -> DeskewedScan:
    (out,) = deskew(Settings(), Scans([scan]), _session(), Imu.empty(), Wheel.empty())
    return out


def _scan(points: ArrayLike, stamp_ns: np.ndarray, reference_ns: int) -> Scan:
    x, y, z = np.ascontiguousarray(np.asarray(points, np.float32).T)
    n = len(x)
    return Scan(
        stamp_ns=stamp_ns, x_m=x, y_m=y, z_m=z, intensity=np.zeros(n, np.float32), ring=np.zeros(n, np.uint16),
        return_no=np.zeros(n, np.uint8), reference_ns=reference_ns, scan_index=0,
    )  # fmt: skip


def _session() -> Session:
    return Session(
        name="bench", format="mcap", start_ns=START_NS, end_ns=START_NS + 10**9, scan_count=1, point_count=1,
        scan_rate_hz=10.0, beams=ROWS, point_time="per point", topics=(), extrinsics=(), problems=(), complete=True,
    )  # fmt: skip
