"""Any container, the same session."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.product import Part
from scanloom.schemas.scans import Scan
from scanloom.schemas.session import RawLog, Session
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.stages.ingest import Settings, ingest
from scanloom.stages.logs.locate import locate
from tests.stages.logs import writing
from tests.stages.logs.writing import ROS1, ROS2, SCAN_NS, START_NS, drive


@dataclass
class Result:
    chunks: dict[str, list[Scan]] = field(default_factory=dict)
    imu: Any = None
    gnss: Any = None
    wheel: Any = None
    session: Any = None

    @property
    def scans(self) -> list[Scan]:
        return [scan for chunk in self.chunks.values() for scan in chunk]

    def codes(self) -> set[str]:
        return {problem.code for problem in self.session.problems}


def run(path: Path | RawLog, **settings: Any) -> Result:
    raw_log = path if isinstance(path, RawLog) else locate(path).raw_log
    result = Result()
    for output in ingest(Settings(**settings), raw_log):
        if isinstance(output, Part):
            result.chunks[output.key] = [scan for scan in output.product]
        else:
            setattr(
                result, {Imu: "imu", Gnss: "gnss", Wheel: "wheel", Session: "session"}[type(output)], output
            )
    return result


CONTAINERS = {
    "rosbag1": lambda d: writing.write_rosbag1(d / "a.bag", drive(ROS1)),
    "rosbag1-bz2": lambda d: writing.write_rosbag1(d / "a.bag", drive(ROS1), "bz2"),
    "rosbag1-lz4": lambda d: writing.write_rosbag1(d / "a.bag", drive(ROS1), "lz4"),
    "sqlite": lambda d: writing.write_rosbag2(d / "a", drive(ROS2), "sqlite"),
    "sqlite-message": lambda d: writing.write_rosbag2(d / "a", drive(ROS2), "sqlite", "message"),
    "sqlite-file": lambda d: writing.write_rosbag2(d / "a", drive(ROS2), "sqlite", "file"),
    "rosbag2-mcap": lambda d: writing.write_rosbag2(d / "a", drive(ROS2), "mcap"),
    "rosbag2-mcap-message": lambda d: writing.write_rosbag2(d / "a", drive(ROS2), "mcap", "message"),
    "rosbag2-mcap-file": lambda d: writing.write_rosbag2(d / "a", drive(ROS2), "mcap", "file"),
    "rosbag2-mcap-storage": lambda d: writing.write_rosbag2(d / "a", drive(ROS2), "mcap", "storage"),
    "mcap-ros1": lambda d: writing.write_mcap(d / "a.mcap", drive(ROS1), profile="ros1"),
    "mcap-ros1-lz4": lambda d: writing.write_mcap(
        d / "a.mcap", drive(ROS1), profile="ros1", compression="lz4"
    ),
    "mcap-lz4": lambda d: writing.write_mcap(d / "a.mcap", drive(ROS2), compression="lz4"),
    "mcap-zstd": lambda d: writing.write_mcap(d / "a.mcap", drive(ROS2), compression="zstd"),
    "mcap-loose": lambda d: writing.write_mcap(d / "a.mcap", drive(ROS2), chunked=False),
    "mcap-unindexed": lambda d: writing.write_mcap(
        d / "a.mcap", drive(ROS2), indexed=False, compression="zstd"
    ),
}


@pytest.mark.parametrize("container", CONTAINERS)
def test_every_container_gives_the_same_session(tmp_path: Path, container: str) -> None:
    result = run(CONTAINERS[container](tmp_path))

    assert len(result.scans) == 5
    expected = writing.cloud_points(2)
    keep = np.delete(np.arange(len(expected)), [3, 5])
    scan = result.scans[2]
    np.testing.assert_array_equal(scan.x_m, expected["x"][keep])
    np.testing.assert_array_equal(scan.ring, expected["ring"][keep])
    np.testing.assert_allclose(scan.stamp_ns - START_NS - 2 * SCAN_NS, expected["time"][keep] * 1e9, atol=100)
    assert [s.scan_index for s in result.scans] == [0, 1, 2, 3, 4]

    np.testing.assert_array_equal(result.imu.stamp_ns, START_NS + np.arange(50) * 10_000_000)
    np.testing.assert_allclose(result.imu.accel_m_s2[7], (0.1, 0.2, 9.8))
    np.testing.assert_allclose(result.imu.gyro_rad_s[7], (0.01, 0.02, 0.03))
    assert (result.gnss.latitude_deg == 48.5).all() and (result.gnss.height_m == 321.0).all()
    np.testing.assert_array_equal(result.gnss.covariance_m2[0], np.diag([1.0, 2.0, 4.0]))
    assert (result.wheel.speed_m_s == 3.0).all() and (result.wheel.yaw_rate_rad_s == 0.25).all()

    session = result.session
    assert session.complete and session.beams == 4 and session.point_time == "per point"
    np.testing.assert_allclose(np.array(session.T_base("lidar"))[:3, 3], (0.5, 0.0, 1.5))
    np.testing.assert_allclose(np.array(session.T_base("gnss"))[:3, 3], (-0.5, 0.0, 1.5))
    roles = {topic.name: topic.role for topic in session.topics}
    assert roles == {"/points": "lidar", "/imu": "imu", "/fix": "gnss", "/odom": "wheel", "/tf_static": "tf"}
    assert not [p for p in session.problems if p.severity != "info"], session.problems
