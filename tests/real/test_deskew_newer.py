"""Deskew of real, fast rotating scans (Newer College, handheld) against the points another tool published.

The three scans are not neighbours in time (their poses differ by up to 50 degrees), so nothing can be learned from
registering them; the motion within each sweep is read from the published points and given as a gyro. What is tested is
all that follows: stamps, interpolation, the reference at mid-sweep, the lever arm of the published IMU frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.scans import Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.deskew import Settings, deskew
from scanloom.stages.geometry.se3 import F8, pose, so3_log, transform

pytestmark = pytest.mark.real

START_NS = 1_600_000_000_000_000_000
T_IMU_LIDAR = pose(
    np.diag([-1.0, -1.0, 1.0]), [-0.006, 0.012, -0.029]
)  # as the published points show at time zero
SLICES = 20


def load(folder: Path, i: int) -> tuple[Scan, F8, F8]:
    """The scan, its published points in the LiDAR frame at the start of the sweep (n, 3), and seconds (n,)."""
    raw = np.fromfile(folder / f"raw_{i:02d}.bin", np.float32).reshape(-1, 3)
    published = np.fromfile(folder / f"deskewed_{i:02d}.bin", np.float32).reshape(-1, 3).astype(float)
    seconds = np.fromfile(folder / f"times_{i:02d}.bin", np.float32).astype(float)
    start = START_NS + i * 10 * 10**9
    n = len(raw)
    scan = Scan(
        stamp_ns=start + (seconds * 1e9).astype(np.int64),
        x_m=raw[:, 0].copy(), y_m=raw[:, 1].copy(), z_m=raw[:, 2].copy(),
        intensity=np.zeros(n, np.float32), ring=np.zeros(n, np.uint16), return_no=np.zeros(n, np.uint8),
        reference_ns=start + 50_000_000, scan_index=i,
    )  # fmt: skip
    return scan, (published - T_IMU_LIDAR[:3, 3]) @ T_IMU_LIDAR[:3, :3], seconds


def best_fit(source: F8, target: F8) -> F8:
    """T_target_source (4, 4) of least squared distance between paired points (Kabsch)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((source - a).T @ (target - b))
    R = Vt.T @ np.diag([1.0, 1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
    return pose(R, b - R @ a)


def published_gyro(scan: Scan, published: F8, seconds: F8) -> Imu:
    """Angular rate from the rotation between raw and published points in slices of the sweep."""
    raw = scan.points().astype(float)
    slot = np.minimum((seconds / seconds.max() * SLICES).astype(int), SLICES - 1)
    middle = np.array([seconds[slot == k].mean() for k in range(SLICES)])
    turned = np.array(
        [so3_log(best_fit(raw[slot == k], published[slot == k])[:3, :3]) for k in range(SLICES)]
    )
    smooth = np.column_stack([np.polyval(np.polyfit(middle, turned[:, k], 2), middle) for k in range(3)])
    rate = np.gradient(smooth, middle, axis=0)
    stamp_ns = scan.reference_ns - 50_000_000 + (middle * 1e9).astype(np.int64)
    return Imu(stamp_ns, rate, np.tile([0.0, 0.0, 9.81], (SLICES, 1)))


def session() -> Session:
    return Session(
        name="newer 06", format="point files", start_ns=START_NS, end_ns=START_NS + 10**9, scan_count=3,
        point_count=70_000, scan_rate_hz=10.0, beams=64, point_time="per point", topics=(), extrinsics=(), problems=(),
        complete=True,
    )  # fmt: skip


def misfit(points: F8, published: F8) -> tuple[float, float]:
    """Median and 95th percentile of the distance to the published points after the best rigid fit, m."""
    distance = np.linalg.norm(transform(best_fit(points, published), points) - published, axis=1)
    return float(np.median(distance)), float(np.percentile(distance, 95))


@pytest.mark.parametrize("i", [0, 1, 2])
def test_with_the_published_rotation_the_published_points_come_out(shared_data: Path, i: int) -> None:
    scan, published, seconds = load(shared_data / "deskew_newer_06", i)
    gyro = published_gyro(scan, published, seconds)
    (flat,) = iter(deskew(Settings(), Scans([scan]), session(), gyro, Wheel.empty()))
    before, after = (
        misfit(scan.points().astype(float), published),
        misfit(flat.points().astype(float), published),
    )
    assert before[0] > 0.15
    assert 1e-4 < after[0] < 0.05
    assert after[1] < 0.2 * before[1]
    ranges = np.linalg.norm(flat.points(), axis=1) - np.linalg.norm(scan.points(), axis=1)
    assert np.abs(ranges).max() < 0.01  # rotation about the sensor alone keeps ranges


def test_scans_that_do_not_belong_together_are_left_alone(shared_data: Path) -> None:
    scans = [load(shared_data / "deskew_newer_06", i)[0] for i in range(3)]
    close = [
        Scan(**{**vars(s), "stamp_ns": s.stamp_ns - s.scan_index * 99 * 10**8, "reference_ns": s.reference_ns - s.scan_index * 99 * 10**8})
        for s in scans
    ]  # fmt: skip
    out = [*iter(deskew(Settings(), Scans(close), session(), Imu.empty(), Wheel.empty()))]
    assert [s.points().tobytes() for s in out] == [s.points().tobytes() for s in close]
