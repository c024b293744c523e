"""Deskew alone: a flat wall seen while turning at speed, a sensor at rest, real handheld scans."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from benchmarks import handheld
from benchmarks.scores import Score
from scanloom.schemas.scans import DeskewedScan, Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.deskew import Settings, deskew
from scanloom.stages.geometry.alignment import rms
from scanloom.stages.geometry.se3 import F8, se3_exp

START_NS = 1_700_000_000_000_000_000
WALL_Y_M, SPEED_M_S, TURN_DEG_S, NOISE_M = 15.0, 20.0, 30.0, 0.01
ROWS, COLUMNS = 32, 1024


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
        yield from _real(newer)


def _real(newer: Path) -> Iterator[Score]:
    """Difference in range to the points another tool published, with its whole motion and with its rotation alone."""
    sweeps = [handheld.load(newer, i) for i in range(handheld.SCANS)]
    how = "of the difference in range to the points another tool published, three handheld scans"
    for name, walking, motion in (
        ("range", True, "its motion"),
        ("turning_range", False, "its rotation alone"),
    ):
        ranges = np.concatenate(
            [handheld.range_differences(s, handheld.deskewed(s, walking=walking)) for s in sweeps]
        )
        yield Score(f"newer_{name}_median_m", float(np.median(ranges)), "m", f"median {how}, given {motion}")
        yield Score(
            f"newer_{name}_p95_m",
            float(np.percentile(ranges, 95)),
            "m",
            f"95th percentile {how}, given {motion}",
        )


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
