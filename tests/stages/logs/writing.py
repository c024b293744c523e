"""Small logs in every container, written by other libraries than the readers under test."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
START_NS = 1_700_000_000_000_000_000
SCAN_NS = 100_000_000
ROWS, COLUMNS = 4, 96
DTYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
)


@dataclass(frozen=True)
class Item:
    """A message to be written: topic, type, time of recording, message."""

    topic: str
    type: str
    receive_ns: int
    message: Any


def stamp(store: Any, ns: int) -> Any:
    return store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)


def header(store: Any, ns: int, frame: str) -> Any:
    kind = store.types["std_msgs/msg/Header"]
    extra = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}
    return kind(stamp=stamp(store, ns), frame_id=frame, **extra)


def cloud_points(i: int, rows: int = ROWS, columns: int = COLUMNS) -> np.ndarray:
    """A small sweep; point 3 has no return (NaN), point 5 neither (zeros)."""
    rng = np.random.default_rng(i)
    points = np.zeros(rows * columns, DTYPE)
    azimuth = -np.repeat(np.linspace(0, 2 * np.pi, columns, endpoint=False), rows)
    distance = rng.uniform(5, 20, rows * columns)
    points["x"], points["y"] = distance * np.cos(azimuth), distance * np.sin(azimuth)
    points["z"] = np.tile(np.linspace(-1, 1, rows), columns)
    points["intensity"] = rng.uniform(0, 100, rows * columns)
    points["ring"] = np.tile(np.arange(rows), columns)
    points["time"] = np.repeat(np.arange(columns) / columns * 0.1, rows)
    points["x"][3] = np.nan
    for name in "xyz":
        points[name][5] = 0
    return points


def cloud(store: Any, ns: int, points: np.ndarray, frame: str = "lidar") -> Any:
    types = store.types
    codes = {"f4": 7, "u2": 4, "f8": 8, "u4": 6, "u1": 2}
    fields = [
        types["sensor_msgs/msg/PointField"](name=n, offset=points.dtype.fields[n][1], datatype=codes[points.dtype[n].str[1:]], count=1)
        for n in points.dtype.names
    ]  # fmt: skip
    size = points.dtype.itemsize
    return types["sensor_msgs/msg/PointCloud2"](
        header=header(store, ns, frame), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=size, row_step=size * len(points), data=np.frombuffer(points.tobytes(), np.uint8), is_dense=False,
    )  # fmt: skip


def vector(store: Any, x: float, y: float, z: float) -> Any:
    return store.types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def quaternion(store: Any, w: float = 1.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    return store.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def imu(store: Any, ns: int, accel: tuple[float, float, float] = (0.1, 0.2, 9.8), frame: str = "imu") -> Any:
    return store.types["sensor_msgs/msg/Imu"](
        header=header(store, ns, frame), orientation=quaternion(store), orientation_covariance=np.zeros(9),
        angular_velocity=vector(store, 0.01, 0.02, 0.03), angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(store, *accel), linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def fix(store: Any, ns: int, status: int = 0) -> Any:
    types = store.types
    return types["sensor_msgs/msg/NavSatFix"](
        header=header(store, ns, "gnss"), status=types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=48.5, longitude=9.25, altitude=321.0, position_covariance=np.diag([1.0, 2.0, 4.0]).reshape(-1),
        position_covariance_type=2,
    )  # fmt: skip


def odometry(store: Any, ns: int, speed: float = 3.0) -> Any:
    t = store.types
    position = t["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0)
    twist = t["geometry_msgs/msg/Twist"](
        linear=vector(store, speed, 0.0, 0.0), angular=vector(store, 0.0, 0.0, 0.25)
    )
    return t["nav_msgs/msg/Odometry"](
        header=header(store, ns, "odom"), child_frame_id="base_link",
        pose=t["geometry_msgs/msg/PoseWithCovariance"](
            pose=t["geometry_msgs/msg/Pose"](position=position, orientation=quaternion(store)), covariance=np.zeros(36)),
        twist=t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def transforms(store: Any, ns: int, edges: dict[tuple[str, str], tuple[float, float, float]]) -> Any:
    t = store.types
    items = [
        t["geometry_msgs/msg/TransformStamped"](
            header=header(store, ns, parent), child_frame_id=child,
            transform=t["geometry_msgs/msg/Transform"](translation=vector(store, *xyz), rotation=quaternion(store)))
        for (parent, child), xyz in edges.items()
    ]  # fmt: skip
    return t["tf2_msgs/msg/TFMessage"](transforms=items)


MOUNTING = {
    ("base_link", "mast"): (0.5, 0.0, 1.0),
    ("mast", "lidar"): (0.0, 0.0, 0.5),
    ("base_link", "imu"): (0.1, 0.2, 0.3),
    ("base_link", "gnss"): (-0.5, 0.0, 1.5),
}


def drive(store: Any, scans: int = 5) -> Iterator[Item]:
    """LiDAR 10 Hz, IMU 100 Hz, GNSS 5 Hz, wheels 20 Hz, mounting, in order of recording (2 ms after the stamp)."""
    items = [Item("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, transforms(store, START_NS, MOUNTING))]
    for i in range(scans):
        ns = START_NS + i * SCAN_NS
        items.append(
            Item(
                "/points",
                "sensor_msgs/msg/PointCloud2",
                ns + SCAN_NS + 2_000_000,
                cloud(store, ns, cloud_points(i)),
            )
        )
    end_ns = scans * SCAN_NS
    for offset in range(0, end_ns, 10_000_000):
        items.append(
            Item("/imu", "sensor_msgs/msg/Imu", START_NS + offset + 2_000_000, imu(store, START_NS + offset))
        )
    for offset in range(0, end_ns, 200_000_000):
        items.append(
            Item(
                "/fix",
                "sensor_msgs/msg/NavSatFix",
                START_NS + offset + 2_000_000,
                fix(store, START_NS + offset),
            )
        )
    for offset in range(0, end_ns, 50_000_000):
        items.append(
            Item(
                "/odom",
                "nav_msgs/msg/Odometry",
                START_NS + offset + 2_000_000,
                odometry(store, START_NS + offset),
            )
        )
    return iter(sorted(items, key=lambda item: item.receive_ns))


def write_rosbag2(
    folder: Path, items: Iterator[Item], storage: str = "mcap", compression: str = "none"
) -> Path:
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer2(folder, version=9, storage_plugin=plugin)
    if compression != "none":
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for item in items:
            if item.topic not in connections:
                connections[item.topic] = writer.add_connection(item.topic, item.type, typestore=ROS2)
            writer.write(
                connections[item.topic], item.receive_ns, ROS2.serialize_cdr(item.message, item.type)
            )
    return folder


def write_rosbag1(
    path: Path, items: Iterator[Item], compression: str = "none", chunk_bytes: int = 4096
) -> Path:
    writer = Writer1(path)
    if compression != "none":
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk_bytes
    with writer:
        connections: dict[str, Any] = {}
        for item in items:
            if item.topic not in connections:
                connections[item.topic] = writer.add_connection(item.topic, item.type, typestore=ROS1)
            writer.write(
                connections[item.topic], item.receive_ns, ROS1.serialize_ros1(item.message, item.type)
            )
    return path


def write_mcap(
    path: Path, items: Iterator[Item], *, profile: str = "ros2", compression: str = "none", chunked: bool = True,
    indexed: bool = True, chunk_bytes: int = 4096,
) -> Path:  # fmt: skip
    """A bare MCAP file by the library of its inventors."""
    from mcap.writer import CompressionType, IndexType, Writer

    ros1 = profile == "ros1"
    store = ROS1 if ros1 else ROS2
    with path.open("wb") as stream:
        writer = Writer(
            stream, chunk_size=chunk_bytes, compression=CompressionType[compression.upper()], use_chunking=chunked,
            index_types=IndexType.ALL if indexed else IndexType.NONE, enable_data_crcs=True,
        )  # fmt: skip
        writer.start(profile, library="test")
        channels: dict[str, int] = {}
        for item in items:
            if item.topic not in channels:
                name = item.type.replace("/msg/", "/") if ros1 else item.type
                text, _ = store.generate_msgdef(item.type, ros_version=1 if ros1 else 2)
                schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", text.encode())
                channels[item.topic] = writer.register_channel(item.topic, "ros1" if ros1 else "cdr", schema)
            raw = (
                store.serialize_ros1(item.message, item.type)
                if ros1
                else store.serialize_cdr(item.message, item.type)
            )
            writer.add_message(channels[item.topic], item.receive_ns, bytes(raw), item.receive_ns)
        writer.finish()
    return path
