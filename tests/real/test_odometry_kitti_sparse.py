"""KITTI 0005 at two scans a second: steps of two metres, LiDAR alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels, PointClass, ScanLabels, Scans
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.deskew import Settings as DeskewSettings
from scanloom.stages.deskew import deskew
from scanloom.stages.geometry.se3 import inverse, se3_log
from scanloom.stages.odometry import Settings, odometry
from tests.real.test_deskew_kitti import DRIVE, load, session, speed_and_yaw_rate

pytestmark = pytest.mark.real

EVERY = 5


def test_every_fifth_scan_is_tracked(shared_data: Path) -> None:
    folder = shared_data / DRIVE
    raw = Scans(load(folder, i) for i in range(0, 81))
    compensated = deskew(DeskewSettings(), raw, session(), Imu.empty(), Wheel.empty())
    scans = [s for s in compensated if s.scan_index % EVERY == 0]
    labels = [
        ScanLabels(np.full(len(s), PointClass.STATIC, np.uint8), s.reference_ns, s.scan_index) for s in scans
    ]
    where = (("session", "0005"), ("chunk", "0000"))
    track = odometry(
        Settings(), Parts([(where, Deskewed(scans))]), Parts([(where, Labels(labels))]), session(), Imu.empty(),
        Wheel.empty(),
    )  # fmt: skip
    assert track.reliable.all()
    assert not track.segment.any()
    motion = se3_log(inverse(track.T_odom_lidar[:-1]) @ track.T_odom_lidar[1:])
    oxts = np.array([speed_and_yaw_rate(folder, i) for i in range(0, 81)])
    mean = np.array([oxts[k : k + EVERY + 1].mean(axis=0) for k in range(0, 80, EVERY)])
    period_s = 1e-9 * np.diff(track.stamp_ns)
    off_m = np.linalg.norm(motion[:, 3:], axis=1) - mean[:, 0] * period_s
    off_rad = motion[:, 2] - mean[:, 1] * period_s
    assert np.linalg.norm(motion[:, 3:], axis=1).max() > 1.9, "steps of two metres"
    assert 0.002 < np.abs(off_m).max() < 0.12
    assert 1e-4 < np.abs(off_rad).max() < np.radians(1.0)
