"""Motion from neighbouring scans on KITTI raw 0005 (HDL-64E, not compensated) against its GNSS/INS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.scans import Deskewed, PointClass, Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise import Settings as DenoiseSettings
from scanloom.stages.denoise import denoise
from scanloom.stages.deskew import Settings, deskew
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.neighbours import ThinScan, twist_between
from scanloom.stages.geometry.registration import VoxelMap, align
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.sweep import Sweep, sweep_times
from scanloom.stages.geometry.voxels import downsample

pytestmark = pytest.mark.real

PERIOD_NS = 103_500_000
DRIVE = "kitti_raw_0005/2011_09_26/2011_09_26_drive_0005_sync"


def load(folder: Path, i: int) -> Scan:
    points = np.fromfile(folder / f"velodyne_points/data/{i:010d}.bin", np.float32).reshape(-1, 4)
    x, y, z, intensity = (points[:, k].copy() for k in range(4))
    start = 1_600_000_000_000_000_000 + i * PERIOD_NS
    return Scan(
        stamp_ns=start + sweep_times(x, y, PERIOD_NS, Sweep(-1, np.pi, False, True)), x_m=x, y_m=y, z_m=z,
        intensity=intensity, ring=np.zeros(len(x), np.uint16), return_no=np.zeros(len(x), np.uint8),
        reference_ns=start + PERIOD_NS // 2, scan_index=i,
    )  # fmt: skip


def speed_and_yaw_rate(folder: Path, i: int) -> F8:
    row = np.loadtxt(folder / f"oxts/data/{i:010d}.txt")
    return row[[8, 19]]


def session() -> Session:
    return Session(
        name="0005", format="kitti raw", start_ns=0, end_ns=1, scan_count=3, point_count=1, scan_rate_hz=9.66, beams=64,
        point_time="from azimuth", topics=(), extrinsics=(), problems=(), complete=True,
    )  # fmt: skip


def test_neighbours_tell_speed_and_turn_rate(shared_data: Path) -> None:
    folder = shared_data / DRIVE
    track = MotionTrack.build(Imu.empty(), Wheel.empty(), session())
    twist = None
    thin = [ThinScan.of(load(folder, i)) for i in range(60, 66)]
    for k in range(5):
        twist = twist_between(thin[k], thin[k + 1], track, twist)
        assert twist is not None
        truth = (speed_and_yaw_rate(folder, 60 + k) + speed_and_yaw_rate(folder, 61 + k)) / 2
        assert abs(np.linalg.norm(twist[3:]) - truth[0]) < 0.3  # 15 mm over half a sweep
        assert abs(twist[2] - truth[1]) < np.radians(1.5)


def test_a_real_street_is_deskewed_and_labelled(shared_data: Path) -> None:
    folder = shared_data / DRIVE
    scans = [load(folder, i) for i in (60, 61)]
    flat = [*iter(deskew(Settings(), Scans(scans), session(), Imu.empty(), Wheel.empty()))]
    moved = np.linalg.norm(flat[0].points() - scans[0].points(), axis=1)
    assert 0.1 < moved.max() < 1.0  # 4 m/s over half a sweep is 0.2 m
    for labels in iter(denoise(DenoiseSettings(), Deskewed(flat), session(), Imu.empty(), Wheel.empty())):
        share = np.bincount(labels.class_, minlength=8) / len(labels)
        assert 0.4 < share[PointClass.GROUND] < 0.75
        assert share[PointClass.OUTLIER] < 0.03
        assert share[[PointClass.EGO, PointClass.OUT_OF_RANGE]].sum() < 0.01


def inertial(folder: Path, scans: range) -> tuple[Imu, Wheel]:
    """Gyro, and the INS's forward speed in place of wheels."""
    rows = np.array([np.loadtxt(folder / f"oxts/data/{i:010d}.txt") for i in scans])
    stamp_ns = 1_600_000_000_000_000_000 + np.array(scans) * PERIOD_NS + PERIOD_NS // 2
    imu = Imu(stamp_ns, rows[:, 17:20].copy(), rows[:, 11:14].copy())
    return imu, Wheel(stamp_ns, rows[:, 8].copy(), np.full(len(rows), np.nan))


@pytest.mark.parametrize("source", ["sensors", "scans"])
def test_scans_at_different_turn_rates_fit_each_other_better(shared_data: Path, source: str) -> None:
    folder = shared_data / DRIVE
    chosen = range(64, 71)  # the turn rate goes from 0 to -10 deg/s
    imu, wheel = inertial(folder, range(60, 75))
    track = MotionTrack.build(imu, wheel, session())
    scans = [load(folder, i) for i in chosen]
    told = (imu, wheel) if source == "sensors" else (Imu.empty(), Wheel.empty())
    flat = [*iter(deskew(Settings(), Scans(scans), session(), *told))]
    rmse = []
    for a, b in ((scans[0], scans[-1]), (flat[0], flat[-1])):
        first, last = a.points().astype(float), b.points().astype(float)
        target = VoxelMap(1.0, 20)
        target.insert(first[downsample(first, 0.2)])
        guess = track.relative(a.reference_ns, b.reference_ns)
        fit = align(
            target, last[downsample(last, 0.7)], guess, max_distance_m=1.0, scale_m=0.2, max_iterations=30
        )
        rmse.append(fit.rmse_m)
    assert 0.03 < rmse[1] < 0.9 * rmse[0]
