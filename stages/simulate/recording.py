"""The log a vehicle would have recorded: a rosbag2 folder with one MCAP file, messages in the order they were received."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import IO, Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from scanloom.stages.geometry.se3 import F8, quaternion_from_matrix
from scanloom.stages.simulate.gnss import GnssTrack
from scanloom.stages.simulate.sweeping import Sweep
from scanloom.stages.simulate.tracks import ImuTrack, WheelTrack

LOG_FILE = "sample_0.mcap"
LIDAR, IMU, WHEEL, GNSS, TF = "/lidar/points", "/imu/data", "/wheel/twist", "/gnss/fix", "/tf_static"
TYPES = {
    TF: "tf2_msgs/msg/TFMessage",
    LIDAR: "sensor_msgs/msg/PointCloud2",
    IMU: "sensor_msgs/msg/Imu",
    WHEEL: "geometry_msgs/msg/TwistWithCovarianceStamped",
    GNSS: "sensor_msgs/msg/NavSatFix",
}
DELAY_NS = {LIDAR: 4_000_000, IMU: 700_000, WHEEL: 1_900_000, GNSS: 38_000_000, TF: 0}
"""From measurement to recorder."""
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
"""As velodyne_pointcloud lays points out; `time` is seconds after the header's stamp."""

Entry = tuple[int, str, int, bytes]
"""Receive time ns, topic, header time ns, serialised message."""


@cache
def _types() -> Any:
    return get_typestore(Stores.ROS2_HUMBLE)


def class_of(name: str) -> Any:
    """The class of a message type."""
    return _types().types[name]


@dataclass
class Recorder:
    """Writes the log, and counts what it writes for `metadata.yaml`."""

    types: dict[str, str] = field(default_factory=lambda: dict(TYPES))
    """Type of each topic."""
    counts: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0

    def record(self, stream: IO[bytes], entries: Iterator[Entry]) -> None:
        """Write all messages; same entries, same bytes."""
        writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=4 << 20)
        writer.start(profile="ros2", library="scanloom")
        channels = {topic: self._channel(writer, topic) for topic in self.types}
        self.counts = dict.fromkeys(self.types, 0)
        for receive_ns, topic, header_ns, data in entries:
            writer.add_message(channels[topic], receive_ns, data, header_ns, self.counts[topic])
            self.first_ns = self.first_ns or receive_ns
            self.last_ns = receive_ns
            self.counts[topic] += 1
        writer.finish()

    def _channel(self, writer: Writer, topic: str) -> int:
        text, _ = _types().generate_msgdef(self.types[topic], ros_version=2)
        schema = writer.register_schema(self.types[topic], "ros2msg", text.encode())
        return int(writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": _qos(topic)}))

    def metadata(self) -> bytes:
        """`metadata.yaml` of the folder, rosbag2 version 5."""
        duration = self.last_ns - self.first_ns
        lines = [
            "rosbag2_bagfile_information:",
            "  version: 5",
            "  storage_identifier: mcap",
            f"  duration: {{nanoseconds: {duration}}}",
            f"  starting_time: {{nanoseconds_since_epoch: {self.first_ns}}}",
            f"  message_count: {sum(self.counts.values())}",
            "  topics_with_message_count:",
        ]
        for topic, count in self.counts.items():
            qos = json.dumps(_qos(topic))  # readers take only channels of the file with this very profile
            kind = f"name: {topic}, type: {self.types[topic]}, serialization_format: cdr"
            meta = f"{{{kind}, offered_qos_profiles: {qos}}}"
            lines += [f"    - topic_metadata: {meta}", f"      message_count: {count}"]
        lines += [
            "  compression_format: ''",
            "  compression_mode: ''",
            f"  relative_file_paths: [{LOG_FILE}]",
            "  files:",
            f"    - path: {LOG_FILE}",
            f"      starting_time: {{nanoseconds_since_epoch: {self.first_ns}}}",
            f"      duration: {{nanoseconds: {duration}}}",
            f"      message_count: {sum(self.counts.values())}",
        ]
        return ("\n".join(lines) + "\n").encode()


def _qos(topic: str) -> str:
    """Quality of service as rosbag2 before version 9 writes it: numbers of the enums; readers want every key.

    History 1 keeps the last, reliability 1 is reliable, durability 1 is transient local and 2 volatile.
    """
    forever = "{sec: 9223372036, nsec: 854775807}"
    lines = ["history: 1", "depth: 10", "reliability: 1", f"durability: {1 if topic == TF else 2}"]
    lines += [f"deadline: {forever}", f"lifespan: {forever}", "liveliness: 1"]
    lines += [f"liveliness_lease_duration: {forever}", "avoid_ros_namespace_conventions: false"]
    return "- " + "\n  ".join(lines)


def entries(
    start_ns: int,
    sweeps: Iterator[Sweep],
    imu: ImuTrack,
    wheel: WheelTrack,
    gnss: GnssTrack,
    frames: Mapping[str, F8],
    images: Iterable[Entry] = (),
) -> Iterator[Entry]:
    """All messages in the order of their reception; `frames` are the poses of sensors that the log tells."""
    streams = (_tf(start_ns, frames), _clouds(sweeps), _imu(imu), _wheel(wheel), _gnss(gnss), iter(images))
    return heapq.merge(*streams, key=lambda entry: entry[0])


def _clouds(sweeps: Iterator[Sweep]) -> Iterator[Entry]:
    for sweep in sweeps:
        last_ns = sweep.start_ns + int(float(sweep.time_s[-1]) * 1e9 if len(sweep.time_s) else 0)
        yield last_ns + DELAY_NS[LIDAR], LIDAR, sweep.start_ns, _serialise(LIDAR, cloud_message(sweep))


def cloud_message(sweep: Sweep) -> Any:
    """A sweep as the LiDAR's driver sends it."""
    points = np.zeros(len(sweep.xyz), POINT)
    points["x"], points["y"], points["z"] = sweep.xyz.T
    points["intensity"], points["ring"], points["time"] = sweep.intensity, sweep.ring, sweep.time_s
    point_field = class_of("sensor_msgs/msg/PointField")
    kinds = {"<f4": 7, "<u2": 4}
    layout = dict(POINT.fields or {})
    fields = [point_field(name, layout[name][1], kinds[layout[name][0].str], 1) for name in POINT.names or ()]
    return class_of(TYPES[LIDAR])(
        header=header(sweep.start_ns, "lidar"),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * len(points),
        data=points.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def _imu(track: ImuTrack) -> Iterator[Entry]:
    unknown = np.array([-1.0, *[0.0] * 8])
    level = class_of("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0)
    for stamp, gyro, accel in zip(track.stamp_ns.tolist(), track.gyro_rad_s, track.accel_m_s2):
        message = class_of(TYPES[IMU])(
            header(stamp, "imu"), level, unknown, _vector(gyro), np.zeros(9), _vector(accel), np.zeros(9)
        )
        yield stamp + DELAY_NS[IMU], IMU, stamp, _serialise(IMU, message)


def _wheel(track: WheelTrack) -> Iterator[Entry]:
    covariance = np.diag([4e-4, 1e-2, 1.0, 1.0, 1.0, 4e-4]).ravel()
    for stamp, speed, turn in zip(
        track.stamp_ns.tolist(), track.speed_m_s.tolist(), track.yaw_rate_rad_s.tolist()
    ):
        twist = class_of("geometry_msgs/msg/Twist")(_vector([speed, 0.0, 0.0]), _vector([0.0, 0.0, turn]))
        with_covariance = class_of("geometry_msgs/msg/TwistWithCovariance")(twist, covariance)
        message = class_of(TYPES[WHEEL])(header(stamp, "base_link"), with_covariance)
        yield stamp + DELAY_NS[WHEEL], WHEEL, stamp, _serialise(WHEEL, message)


def _gnss(track: GnssTrack) -> Iterator[Entry]:
    for k, stamp in enumerate(track.stamp_ns.tolist()):
        status = class_of("sensor_msgs/msg/NavSatStatus")(int(track.status[k]), 1)
        latitude, longitude, height = track.geodetic[k].tolist()
        covariance = np.diag(track.variance_m2[k]).ravel()
        message = class_of(TYPES[GNSS])(
            header(stamp, "gnss"), status, latitude, longitude, height, covariance, 2
        )
        yield stamp + DELAY_NS[GNSS], GNSS, stamp, _serialise(GNSS, message)


def _tf(start_ns: int, frames: Mapping[str, F8]) -> Iterator[Entry]:
    transforms = [_transform(start_ns, child, T) for child, T in frames.items()]
    yield start_ns, TF, start_ns, _serialise(TF, class_of(TYPES[TF])(transforms))


def _transform(stamp_ns: int, child: str, T: F8) -> Any:
    qw, qx, qy, qz = quaternion_from_matrix(T[:3, :3]).tolist()
    rotation = class_of("geometry_msgs/msg/Quaternion")(qx, qy, qz, qw)
    transform = class_of("geometry_msgs/msg/Transform")(_vector(T[:3, 3]), rotation)
    return class_of("geometry_msgs/msg/TransformStamped")(header(stamp_ns, "base_link"), child, transform)


def _vector(xyz: Any) -> Any:
    return class_of("geometry_msgs/msg/Vector3")(*(float(v) for v in xyz))


def header(stamp_ns: int, frame: str) -> Any:
    """Header of a message."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return class_of("std_msgs/msg/Header")(
        class_of("builtin_interfaces/msg/Time")(seconds, nanoseconds), frame
    )


def _serialise(topic: str, message: Any) -> bytes:
    return serialised(TYPES[topic], message)


def serialised(kind: str, message: Any) -> bytes:
    """A message of a type, as CDR."""
    return bytes(_types().serialize_cdr(message, kind))
