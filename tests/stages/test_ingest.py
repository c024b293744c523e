"""Any container, the same session."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput, ScanloomError, UsageError
from scanloom.schemas.product import Part
from scanloom.schemas.scans import Scan
from scanloom.schemas.session import RawLog, Session
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.stages.ingest import Settings, ingest
from scanloom.stages.logs.locate import locate
from tests.stages.logs import writing
from tests.stages.logs.writing import (
    ROS1,
    ROS2,
    SCAN_NS,
    START_NS,
    Item,
    cloud,
    cloud_points,
    drive,
    write_mcap,
)


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
            result.chunks[output.key] = list(iter(output.product))
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
    assert (result.gnss.latitude_deg == 48.5).all()
    assert (result.gnss.height_m == 321.0).all()
    np.testing.assert_array_equal(result.gnss.covariance_m2[0], np.diag([1.0, 2.0, 4.0]))
    assert (result.wheel.speed_m_s == 3.0).all()
    assert (result.wheel.yaw_rate_rad_s == 0.25).all()

    session = result.session
    assert session.complete
    assert (session.beams, session.point_time) == (4, "per point")
    np.testing.assert_allclose(np.array(session.T_base("lidar"))[:3, 3], (0.5, 0.0, 1.5))
    np.testing.assert_allclose(np.array(session.T_base("gnss"))[:3, 3], (-0.5, 0.0, 1.5))
    roles = {topic.name: topic.role for topic in session.topics}
    assert roles == {"/points": "lidar", "/imu": "imu", "/fix": "gnss", "/odom": "wheel", "/tf_static": "tf"}
    assert not [p for p in session.problems if p.severity != "info"], session.problems


def clouds(stamps_ns: list[int], topic: str = "/points", **changes: Any) -> list[Item]:
    """Clouds recorded one after the other, whatever their stamps say."""
    items = []
    for i, stamp in enumerate(stamps_ns):
        points = changes.get("points", cloud_points)(i)
        receive = START_NS + (i + 1) * SCAN_NS
        items.append(Item(topic, "sensor_msgs/msg/PointCloud2", receive, cloud(ROS2, stamp, points)))
    return items


def recorded(path: Path, items: list[Item]) -> Path:
    return write_mcap(path / "a.mcap", iter(sorted(items, key=lambda item: item.receive_ns)))


def test_reference_is_the_middle_of_the_sweep(tmp_path: Path) -> None:
    for scan in run(recorded(tmp_path, list(drive(ROS2)))).scans:
        first, last = int(scan.stamp_ns.min()), int(scan.stamp_ns.max())
        assert abs(scan.reference_ns - (first + last) // 2) <= 1
        assert 0.95e8 < last - first < 1e8


def test_chunks_end_by_time_and_by_points(tmp_path: Path) -> None:
    path = recorded(tmp_path, clouds([START_NS + i * SCAN_NS for i in range(25)]))
    by_time = run(path, chunk_s=1.0)
    assert [len(chunk) for chunk in by_time.chunks.values()] == [10, 10, 5]
    assert list(by_time.chunks) == ["0000", "0001", "0002"]
    by_points = run(path, chunk_points=1500)
    assert [len(chunk) for chunk in by_points.chunks.values()] == [3] * 8 + [1]
    assert [scan.scan_index for scan in by_points.scans] == list(range(25))


def test_chunks_that_are_not_consumed_do_not_leak_into_the_next(tmp_path: Path) -> None:
    path = recorded(tmp_path, clouds([START_NS + i * SCAN_NS for i in range(25)]))
    firsts = []
    for output in ingest(Settings(chunk_s=1.0), locate(path).raw_log):
        if isinstance(output, Part):
            firsts.append(next(iter(output.product)).scan_index)
    assert firsts == [0, 10, 20]


def test_swapped_scans_are_put_right_and_repeated_ones_dropped(tmp_path: Path) -> None:
    order = [0, 1, 3, 2, 4, 4, 5, 6, 1, 7]
    result = run(
        recorded(tmp_path, clouds([START_NS + i * SCAN_NS for i in order], points=lambda i: cloud_points(0)))
    )
    references = [scan.reference_ns for scan in result.scans]
    assert references == sorted(set(references))
    assert len(references) == 8
    assert {"lidar.late", "lidar.backwards", "lidar.duplicate"} <= result.codes()


def test_times_come_from_azimuth_where_points_have_none(tmp_path: Path) -> None:
    def timeless(i: int) -> np.ndarray:
        points = cloud_points(i)
        return np.lib.recfunctions.drop_fields(points, "time", usemask=False)

    import numpy.lib.recfunctions  # noqa: F401

    result = run(recorded(tmp_path, clouds([START_NS + i * SCAN_NS for i in range(4)], points=timeless)))
    assert result.session.point_time == "from azimuth"
    assert "lidar.no_point_time" in result.codes()
    scan, expected = result.scans[1], np.delete(cloud_points(1)["time"], [3, 5]) * 1e9
    assert np.abs(scan.stamp_ns - START_NS - SCAN_NS - expected).max() < 0.03 * SCAN_NS
    none = run(tmp_path / "a.mcap", point_time="none")
    assert (none.scans[1].stamp_ns == START_NS + SCAN_NS).all()


def test_point_times_that_are_all_the_same_or_absurd_are_replaced(tmp_path: Path) -> None:
    def flat(i: int) -> np.ndarray:
        points = cloud_points(i)
        points["time"] = 0.0
        return points

    result = run(recorded(tmp_path, clouds([START_NS + i * SCAN_NS for i in range(4)], points=flat)))
    assert result.session.point_time == "from azimuth"
    assert np.ptp(result.scans[0].stamp_ns) > 0.9 * SCAN_NS


def test_ambiguous_topics_are_said_and_can_be_chosen(tmp_path: Path) -> None:
    stamps = [START_NS + i * SCAN_NS for i in range(4)]
    thin = clouds(stamps, "/filtered_points", points=lambda i: cloud_points(i)[:300])
    path = recorded(tmp_path, [*clouds(stamps, "/velodyne_points"), *thin])
    result = run(path)
    [problem] = [p for p in result.session.problems if p.code == "lidar.ambiguous"]
    assert "/velodyne_points" in problem.text
    assert "ingest.lidar_topic" in problem.text
    assert len(result.scans[0]) > 300
    assert len(run(path, lidar_topic="/filtered_points").scans[0]) < 300
    with pytest.raises(UsageError, match="did you mean /filtered_points"):
        run(path, lidar_topic="/filterd_points")


def test_a_sensor_can_be_left_out_and_mounted(tmp_path: Path) -> None:
    path = recorded(tmp_path, list(drive(ROS2)))
    result = run(
        path, imu_topic="none", lidar_on_base=(1.0, 2.0, 3.0, 0.0, 0.0, np.pi / 2), gnss_offset_s=0.5
    )
    assert len(result.imu) == 0
    np.testing.assert_allclose(
        np.array(result.session.T_base("lidar")) @ (1, 0, 0, 1), (1, 3, 3, 1), atol=1e-12
    )
    assert result.gnss.stamp_ns[0] == START_NS + 500_000_000
    sources = {e.sensor: e.source for e in result.session.extrinsics}
    assert sources == {"lidar": "session file", "gnss": "tf", "wheel": "tf"}


def test_a_sensor_with_its_own_clock_is_shifted_by_receive_times(tmp_path: Path) -> None:
    items = list(drive(ROS2, scans=10))
    for i, item in enumerate(items):
        if item.topic == "/imu":
            since_boot = item.receive_ns - START_NS - 2_000_000 + 77_000_000_000
            items[i] = Item(item.topic, item.type, item.receive_ns, writing.imu(ROS2, since_boot))
    result = run(recorded(tmp_path, items))
    assert "imu.clock_shifted" in result.codes()
    # the LiDAR's messages are recorded a sweep after their stamp, the IMU's at once
    assert abs(int(result.imu.stamp_ns[0]) - START_NS) < 2 * SCAN_NS
    kept = run(tmp_path / "a.mcap", align_clocks=False)
    assert kept.imu.stamp_ns[0] == 77_000_000_000
    assert "imu.no_overlap" in kept.codes()


def test_a_sensor_that_stops_early_is_said(tmp_path: Path) -> None:
    items = [i for i in drive(ROS2, scans=40) if i.topic != "/imu" or i.receive_ns < START_NS + 2_000_000_000]
    [problem] = [p for p in run(recorded(tmp_path, items)).session.problems if p.code == "imu.partial"]
    assert "50 %" in problem.text


def test_acceleration_in_units_of_gravity_is_converted(tmp_path: Path) -> None:
    items = [
        Item(i.topic, i.type, i.receive_ns, writing.imu(ROS2, i.receive_ns - 2_000_000, (0, 0, 1.0))) if i.topic == "/imu" else i
        for i in drive(ROS2)
    ]  # fmt: skip
    result = run(recorded(tmp_path, items))
    np.testing.assert_allclose(result.imu.accel_m_s2, [[0, 0, 9.80665]] * 50)
    assert "imu.units_g" in result.codes()


def test_what_is_no_number_and_what_has_no_stamp_is_said(tmp_path: Path) -> None:
    items = list(drive(ROS2))
    for i, item in enumerate(items):
        if item.topic == "/imu" and i % 7 == 0:
            items[i] = Item(
                item.topic, item.type, item.receive_ns, writing.imu(ROS2, item.receive_ns, (0, 0, np.nan))
            )
        if item.topic == "/odom":
            items[i] = Item(item.topic, item.type, item.receive_ns, writing.odometry(ROS2, 0))
    result = run(recorded(tmp_path, items))
    assert {"imu.broken", "log.unstamped"} <= result.codes()
    assert 30 < len(result.imu) < 50
    assert np.isfinite(result.imu.accel_m_s2).all()
    assert result.wheel.stamp_ns[0] == START_NS + 2_000_000
    assert len(result.wheel) == 10


def test_other_encodings_are_named(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(
            "/points", "protobuf", writer.register_schema("foxglove.PointCloud", "protobuf", b"")
        )
        writer.add_message(channel, 1, b"123", 1)
        writer.finish()
    with pytest.raises(InvalidInput, match=r"/points: encoding 'protobuf' cannot be read"):
        run(tmp_path / "a.mcap")


def test_the_name_does_not_depend_on_where_the_log_lies(tmp_path: Path) -> None:
    results = []
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
        results.append(run(recorded(tmp_path / folder, list(drive(ROS2)))).session)
    assert results[0] == results[1]


def damaged(data: bytes, rng: np.random.Generator, how: int) -> bytes:
    """Cut, bits flipped, or a part overwritten."""
    if how == 0:
        return data[: int(rng.integers(len(data)))]
    out = bytearray(data)
    if how == 1:
        for at in rng.integers(len(out), size=5):
            out[at] ^= 1 << int(rng.integers(8))
        return bytes(out)
    at = int(rng.integers(len(out)))
    out[at : at + int(rng.integers(1, 3000))] = rng.bytes(700)
    return bytes(out)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("container", sorted(CONTAINERS))
def test_damage_gives_a_part_or_a_clear_error_and_nothing_else(tmp_path: Path, container: str) -> None:
    path = CONTAINERS[container](tmp_path)
    [file] = [path] if path.is_file() else [p for p in path.iterdir() if p.name != "metadata.yaml"]
    data = file.read_bytes()
    refusals: list[ScanloomError] = []
    for seed in range(12):
        file.write_bytes(damaged(data, np.random.default_rng(seed), seed % 3))
        try:
            result = run(path)
        except ScanloomError as error:
            refusals.append(error)
            continue
        assert 2 <= len(result.scans) <= 5
        assert len(result.scans) == 5 or result.codes() & {
            "log.incomplete",
            "lidar.broken",
            "lidar.late",
            "lidar.damaged",
        }
    assert all(error.what and error.where for error in refusals)


def test_kitti_raw_is_read_whole(shared_data: Path) -> None:
    counts, last_ns = [], 0
    for output in ingest(Settings(), locate(shared_data / "kitti_raw_0005").raw_log):
        if isinstance(output, Part):
            for scan in output.product:
                counts.append(len(scan))
                assert scan.reference_ns > last_ns
                last_ns = scan.reference_ns
        elif isinstance(output, Session):
            session = output
    assert len(counts) == session.scan_count == 100
    assert 115_000 < np.mean(counts) < 130_000
    assert 9.6 < session.scan_rate_hz < 9.7
    assert session.beams == 64


def test_ouster_with_ros1_names_is_read(shared_data: Path) -> None:
    result = run(shared_data / "bags" / "ouster_0.2s_ros1names.mcap")
    assert len(result.scans) == 2
    assert all(40_000 < len(scan) < 131_072 for scan in result.scans)
    assert result.session.beams == 64
    assert {"imu.clock_shifted", "extrinsics.base"} <= result.codes()
    assert 9.0 < np.linalg.norm(result.imu.accel_m_s2.mean(axis=0)) < 10.0


@pytest.mark.parametrize("name", ["husky_imu_wheel_gnss.bag", "tilt_laser_imu_gnss.bag"])
def test_logs_without_3d_lidar_are_refused_with_the_reason(shared_data: Path, name: str) -> None:
    with pytest.raises(InvalidInput, match=r"no 3D LiDAR topic.*It holds.*IMU, GNSS.*Next: .*"):
        run(shared_data / "bags" / name)
