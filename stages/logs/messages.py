"""ROS messages from their bytes: the few types a map needs, in CDR (ROS 2) and in ROS 1 serialization.

Written by hand, because a cloud must not be copied and a damaged message must not raise anything but `ValueError`.
Sources: OMG CDR (DDSI-RTPS 2.5, section 10), the ROS 1 wiki page "Messages/Serialization", common_interfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from scanloom.stages.geometry.se3 import F8, matrix_from_quaternion, pose
from scanloom.stages.logs import image_messages
from scanloom.stages.logs.containers import MAX_MESSAGE_BYTES, decompress_zstd
from scanloom.stages.logs.cursor import Cursor
from scanloom.stages.logs.records import (
    LIVOX_POINT,
    Body,
    GnssSample,
    ImuSample,
    Kind,
    LivoxCloud,
    PointCloud2,
    PointField,
    Transform,
    Transforms,
    Undecodable,
    WheelSample,
)


def _imu(c: Cursor, receive_ns: int) -> Body:
    stamp_ns, frame = c.header()
    values = c.doubles(37)
    gx, gy, gz = values[13:16]
    ax, ay, az = values[25:28]
    return ImuSample(stamp_ns, receive_ns, (gx, gy, gz), (ax, ay, az), frame)


def _gnss(c: Cursor, receive_ns: int) -> Body:
    stamp_ns, frame = c.header()
    status = int(c.number("b"))
    c.number("H")
    latitude, longitude, height = c.doubles(3)
    covariance = c.doubles(9)
    known = int(c.number("B")) != 0
    return GnssSample(
        stamp_ns,
        receive_ns,
        latitude,
        longitude,
        height,
        covariance,
        status,
        frame_id=frame,
        covariance_known=known,
    )


def _odometry(c: Cursor, receive_ns: int) -> Body:
    stamp_ns, frame = c.header()
    child = c.text().lstrip("/")
    c.doubles(43)
    twist = c.doubles(6)
    return WheelSample(stamp_ns, receive_ns, twist[0], twist[5], child or frame)


def _twist(c: Cursor, receive_ns: int) -> Body:
    stamp_ns, frame = c.header()
    twist = c.doubles(6)
    return WheelSample(stamp_ns, receive_ns, twist[0], twist[5], frame)


def _tf(c: Cursor, receive_ns: int) -> Body:
    transforms = tuple(_transform(c) for _ in range(c.length()))
    stamp_ns = transforms[0].stamp_ns if transforms else receive_ns
    return Transforms(stamp_ns, receive_ns, transforms, static=False)


def _transform(c: Cursor) -> Transform:
    stamp_ns, parent = c.header()
    child = c.text().lstrip("/")
    x, y, z, qx, qy, qz, qw = c.doubles(7)
    return Transform(stamp_ns, parent, child, _pose(np.array([qw, qx, qy, qz]), np.array([x, y, z])))


def _pose(q: F8, t: F8) -> F8:
    norm = float(np.linalg.norm(q))
    if not math.isfinite(norm) or abs(norm - 1) > 0.1 or not np.isfinite(t).all():
        raise ValueError("a transform whose quaternion has not length one")
    return pose(matrix_from_quaternion(q / norm), t)


def _cloud(c: Cursor, receive_ns: int) -> Body:
    stamp_ns, frame = c.header()
    height, width = int(c.number("I")), int(c.number("I"))
    fields = tuple(_field(c) for _ in range(c.length()))
    bigendian = bool(c.number("B"))
    point_step, row_step = int(c.number("I")), int(c.number("I"))
    data = np.frombuffer(c.take(int(c.number("I"))), np.uint8)
    dense = bool(c.number("B"))
    return PointCloud2(
        stamp_ns, receive_ns, frame, height, width, fields, bigendian, point_step, row_step, data, dense
    )


def _field(c: Cursor) -> PointField:
    name = c.text()
    return PointField(name, int(c.number("I")), int(c.number("B")), int(c.number("I")))


_LIVOX_CODES = (
    ("offset_time", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
)  # fmt: skip


def _livox(c: Cursor, receive_ns: int) -> Body:
    stamp_ns, frame = c.header()
    timebase_ns = int(c.number("Q"))
    c.number("I")
    c.take(4)
    count = int(c.number("I"))
    # CDR aligns every element to 4 bytes, so that the last one alone is 19 bytes long
    stride = LIVOX_POINT.itemsize if c.ros1 else 20
    needed = max(count * stride - (stride - LIVOX_POINT.itemsize), 0)
    raw = bytes(c.take(needed)) + bytes(stride - LIVOX_POINT.itemsize if count else 0)
    padding = [] if c.ros1 else [("padding", "u1")]
    layout = np.dtype([(name, c.order + code) for name, code in _LIVOX_CODES] + padding)
    return LivoxCloud(stamp_ns, receive_ns, frame, timebase_ns, np.frombuffer(raw, layout, count))


_DECODERS: dict[str, tuple[Kind, Callable[[Cursor, int], Body]]] = {
    "sensor_msgs/PointCloud2": ("cloud", _cloud),
    "livox_ros_driver/CustomMsg": ("cloud", _livox),
    "livox_ros_driver2/CustomMsg": ("cloud", _livox),
    "livox_interfaces/CustomMsg": ("cloud", _livox),
    "sensor_msgs/Imu": ("imu", _imu),
    "sensor_msgs/NavSatFix": ("gnss", _gnss),
    "nav_msgs/Odometry": ("wheel", _odometry),
    "geometry_msgs/TwistStamped": ("wheel", _twist),
    "geometry_msgs/TwistWithCovarianceStamped": ("wheel", _twist),
    "tf2_msgs/TFMessage": ("tf", _tf),
    "tf/tfMessage": ("tf", _tf),
    "sensor_msgs/Image": ("images", image_messages.raw_image),
    "sensor_msgs/CompressedImage": ("images", image_messages.compressed_image),
    "sensor_msgs/CameraInfo": ("camera", image_messages.camera_info),
}


def ros2_name(type_name: str) -> str:
    """`sensor_msgs/Imu` as `sensor_msgs/msg/Imu`; names of ROS 2 stay as they are."""
    package, _, rest = type_name.partition("/")
    return type_name if not rest or rest.startswith("msg/") else f"{package}/msg/{rest}"


def _short(type_name: str) -> str:
    return type_name.replace("/msg/", "/")


def kind_of(type_name: str) -> Kind:
    """What a topic of this type may be used for."""
    short = _short(type_name)
    return _DECODERS[short][0] if short in _DECODERS else "other"


def decode(data: memoryview, type_name: str, encoding: str, topic: str, receive_ns: int) -> Body:
    """One message; `encoding` is `cdr` or `ros1`. Bytes that do not fit the type give `Undecodable`."""
    try:
        if encoding == "cdr" and bytes(data[:4]) == _ZSTD:
            data = _unpacked(data)
        body = _DECODERS[_short(type_name)][1](Cursor(data, encoding), receive_ns)
    except (ValueError, OverflowError) as error:
        return Undecodable(receive_ns, receive_ns, str(error))
    if isinstance(body, Transforms) and topic.rstrip("/").endswith("tf_static"):
        return Transforms(body.stamp_ns, body.receive_ns, body.transforms, static=True)
    return body


_ZSTD = b"\x28\xb5\x2f\xfd"
"""Begins a message that rosbag2 compressed; no CDR message begins so."""


def _unpacked(data: memoryview) -> memoryview:
    import zstandard

    try:
        size = zstandard.get_frame_parameters(data).content_size
        if size == zstandard.CONTENTSIZE_UNKNOWN:
            size = MAX_MESSAGE_BYTES
        if size > MAX_MESSAGE_BYTES:
            raise ValueError(f"a compressed message claims {size / 2**20:.0f} MiB")
        return memoryview(decompress_zstd(data, size))
    except (zstandard.ZstdError, MemoryError) as error:
        raise ValueError(f"a compressed message cannot be unpacked ({error})") from error
