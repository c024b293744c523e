"""Messages from bytes: both serializations, both byte orders, and bytes that are no message."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg

from scanloom.stages.logs.messages import decode, kind_of, ros2_name
from scanloom.stages.logs.records import (
    GnssSample,
    ImuSample,
    LivoxCloud,
    PointCloud2,
    Transforms,
    Undecodable,
    WheelSample,
)
from tests.stages.logs import writing
from tests.stages.logs.writing import ROS1, ROS2, START_NS

LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver2/CustomPoint[] points
"""
POINT = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
for store in (ROS1, ROS2):
    store.register(get_types_from_msg(POINT, "livox_ros_driver2/msg/CustomPoint"))
    store.register(get_types_from_msg(LIVOX, "livox_ros_driver2/msg/CustomMsg"))


def packed(store: Any, message: Any, kind: str, *, little: bool = True) -> tuple[memoryview, str]:
    if store is ROS1:
        return memoryview(bytes(store.serialize_ros1(message, kind))), "ros1"
    return memoryview(bytes(store.serialize_cdr(message, kind, little_endian=little))), "cdr"


def decoded(store: Any, message: Any, kind: str, *, little: bool = True) -> Any:
    data, encoding = packed(store, message, kind, little=little)
    return decode(data, kind, encoding, "/topic", 42)


BOTH = pytest.mark.parametrize(("store", "little"), [(ROS1, True), (ROS2, True), (ROS2, False)])


@BOTH
def test_samples(store: Any, little: bool) -> None:
    body = decoded(store, writing.imu(store, START_NS, (1.0, 2.0, 3.0)), "sensor_msgs/msg/Imu", little=little)
    assert body == ImuSample(START_NS, 42, (0.01, 0.02, 0.03), (1.0, 2.0, 3.0), "imu")
    body = decoded(store, writing.fix(store, START_NS, -1), "sensor_msgs/msg/NavSatFix", little=little)
    covariance = (1.0, 0, 0, 0, 2.0, 0, 0, 0, 4.0)
    assert body == GnssSample(START_NS, 42, 48.5, 9.25, 321.0, covariance, -1, frame_id="gnss")
    body = decoded(store, writing.odometry(store, START_NS, -2.5), "nav_msgs/msg/Odometry", little=little)
    assert body == WheelSample(START_NS, 42, -2.5, 0.25, "base_link")


@BOTH
@pytest.mark.parametrize("frame", ["", "a", "abcdefgh", "a_frame_of_odd_length"])
def test_alignment_follows_texts_of_any_length(store: Any, little: bool, frame: str) -> None:
    body = decoded(store, writing.imu(store, START_NS, frame=frame), "sensor_msgs/msg/Imu", little=little)
    assert (body.frame_id, body.accel_m_s2) == (frame, (0.1, 0.2, 9.8))
    twist = store.types["geometry_msgs/msg/Twist"](
        linear=writing.vector(store, 1.5, 0.0, 0.0), angular=writing.vector(store, 0.0, 0.0, -0.5)
    )
    stamped = store.types["geometry_msgs/msg/TwistStamped"](
        header=writing.header(store, START_NS, frame), twist=twist
    )
    body = decoded(store, stamped, "geometry_msgs/msg/TwistStamped", little=little)
    assert body == WheelSample(START_NS, 42, 1.5, -0.5, frame)


@BOTH
def test_clouds_are_not_copied(store: Any, little: bool) -> None:
    points = writing.cloud_points(1)
    data, encoding = packed(
        store, writing.cloud(store, START_NS, points), "sensor_msgs/msg/PointCloud2", little=little
    )
    body = decode(data, "sensor_msgs/PointCloud2", encoding, "/points", 42)
    assert isinstance(body, PointCloud2)
    assert (body.width, body.height, body.point_step) == (len(points), 1, points.dtype.itemsize)
    assert [field.name for field in body.fields] == list(points.dtype.names)
    assert body.data.tobytes() == points.tobytes()
    assert np.shares_memory(body.data, np.frombuffer(data, np.uint8))


@BOTH
@pytest.mark.parametrize("count", [0, 1, 5])
def test_livox(store: Any, little: bool, count: int) -> None:
    types = store.types
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-50, 50, (count, 3)).astype(np.float32)
    points = [
        types["livox_ros_driver2/msg/CustomPoint"](
            offset_time=i * 1000, x=x, y=y, z=z, reflectivity=i, tag=16, line=i % 6)
        for i, (x, y, z) in enumerate(xyz.tolist())
    ]  # fmt: skip
    message = types["livox_ros_driver2/msg/CustomMsg"](
        header=writing.header(store, START_NS, "livox"), timebase=START_NS + 7, point_num=count, lidar_id=1,
        rsvd=np.zeros(3, np.uint8), points=points,
    )  # fmt: skip
    body = decoded(store, message, "livox_ros_driver2/msg/CustomMsg", little=little)
    assert isinstance(body, LivoxCloud)
    assert (body.timebase_ns, len(body.points)) == (START_NS + 7, count)
    np.testing.assert_array_equal(body.points["y"], xyz[:, 1])
    np.testing.assert_array_equal(body.points["offset_time"], np.arange(count) * 1000)
    np.testing.assert_array_equal(body.points["line"], np.arange(count) % 6)


@BOTH
def test_transforms(store: Any, little: bool) -> None:
    message = writing.transforms(store, START_NS, writing.MOUNTING)
    body = decoded(store, message, "tf2_msgs/msg/TFMessage", little=little)
    assert isinstance(body, Transforms)
    edges = {(t.parent, t.child): tuple(t.T_parent_child[:3, 3]) for t in body.transforms}
    assert edges == writing.MOUNTING
    assert not body.static
    data, encoding = packed(store, message, "tf2_msgs/msg/TFMessage", little=little)
    static = decode(data, "tf2_msgs/TFMessage", encoding, "/tf_static", 42)
    assert isinstance(static, Transforms)
    assert static.static


KINDS = [
    "sensor_msgs/PointCloud2", "livox_ros_driver/CustomMsg", "sensor_msgs/Imu", "sensor_msgs/NavSatFix",
    "nav_msgs/Odometry", "geometry_msgs/TwistStamped", "tf2_msgs/TFMessage",
]  # fmt: skip


@given(data=st.binary(max_size=400), kind=st.sampled_from(KINDS), encoding=st.sampled_from(["cdr", "ros1"]))
@settings(max_examples=300, deadline=None)
def test_any_bytes_give_a_message_or_a_reason(data: bytes, kind: str, encoding: str) -> None:
    head = b"\0\1\0\0" if encoding == "cdr" else b""
    decode(memoryview(head + data), kind, encoding, "/topic", 0)
    body = decode(memoryview(data[:3]), kind, encoding, "/topic", 0)
    assert isinstance(body, Undecodable)


@pytest.mark.parametrize("store", [ROS1, ROS2])
def test_a_message_cut_anywhere_is_undecodable(store: Any) -> None:
    data, encoding = packed(
        store, writing.cloud(store, START_NS, writing.cloud_points(0)), "sensor_msgs/msg/PointCloud2"
    )
    for end in range(0, len(data), 37):
        assert isinstance(decode(data[:end], "sensor_msgs/PointCloud2", encoding, "/points", 0), Undecodable)


def test_compressed_message_that_claims_too_much() -> None:
    import zstandard

    bomb = zstandard.compress(bytes(300 << 20))
    body = decode(memoryview(bomb), "sensor_msgs/Imu", "cdr", "/imu", 0)
    assert isinstance(body, Undecodable)
    assert "300 MiB" in body.reason


def test_names() -> None:
    assert ros2_name("sensor_msgs/Imu") == "sensor_msgs/msg/Imu"
    assert ros2_name("sensor_msgs/msg/Imu") == "sensor_msgs/msg/Imu"
    assert ros2_name("foxglove.PointCloud") == "foxglove.PointCloud"
    assert kind_of("sensor_msgs/msg/PointCloud2") == kind_of("sensor_msgs/PointCloud2") == "cloud"
    assert kind_of("sensor_msgs/LaserScan") == "other"
