"""What every log gives, whatever its container: messages in order of time, each already in one of a few shapes.

Bags (rosbag1, rosbag2, MCAP) and folders of scans (KITTI, PCD, PLY, `.bin`) are both a `LogSource`; ingest reads
nothing else. A source never decodes a cloud itself: it hands out a `PointCloud2`, a `LivoxCloud` or a `CloudFile`, so
that a survey can look at headers only. `pointcloud.decode_pointcloud2` and `pointcloud.decode_livox` make a `Cloud`
of the first two, `CloudFile.load()` of the third.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera
from scanloom.schemas.session import Extrinsic, Problem
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.sweep import Sweep

StampAt = Literal["start", "middle", "end"]
"""Which moment of a sweep the stamp of its header names."""


@dataclass(frozen=True)
class Cloud:
    """One decoded sweep, before anything is dropped. All columns have one row per point, in the order measured.

    Points without return (NaN, infinite, all zero) may still be in it; ingest drops and counts them.
    """

    stamp_ns: int
    """Stamp of the header."""
    receive_ns: int
    """Time the message was recorded; the header's stamp for logs that know no other."""
    x_m: NDArray[np.float32]
    y_m: NDArray[np.float32]
    z_m: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.uint16]
    return_no: NDArray[np.uint8]
    time_ns: NDArray[np.int64] | None
    """Absolute time of each point on the LiDAR's clock; None when the log does not tell (then it comes from azimuth)."""
    stamp_at: StampAt = "start"
    """What `stamp_ns` names; used only where `time_ns` is None."""
    remark: str = ""
    """What the decoder found odd or had to guess (for instance `field time taken as seconds after the header`)."""
    compensated: bool = False
    """The points were moved to the time of the stamp before they were recorded (KITTI odometry); they have no own."""
    sweep: Sweep | None = None
    """How the LiDAR turned, where the format fixes it (KITTI); None when it is to be read from the points' order."""


@dataclass(frozen=True)
class PointField:
    """One field of a PointCloud2: datatype as in sensor_msgs/PointField (1 int8 ... 7 float32, 8 float64)."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclass(frozen=True)
class PointCloud2:
    """A sensor_msgs/PointCloud2 as it came, its bytes not copied and not yet looked at."""

    stamp_ns: int
    receive_ns: int
    frame_id: str
    height: int
    width: int
    fields: tuple[PointField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: NDArray[np.uint8]
    """Read-only bytes; may be shorter or longer than `height * row_step` (the decoder checks)."""
    is_dense: bool


LIVOX_POINT = np.dtype(
    [
        ("offset_time", "<u4"),
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("reflectivity", "u1"),
        ("tag", "u1"),
        ("line", "u1"),
    ]
)
"""Fields of livox_ros_driver CustomPoint; arrays may have a larger item size (CDR pads to 20 bytes)."""


@dataclass(frozen=True)
class LivoxCloud:
    """A livox_ros_driver(2)/CustomMsg; `offset_time` counts ns from `timebase_ns`."""

    stamp_ns: int
    receive_ns: int
    frame_id: str
    timebase_ns: int
    points: NDArray[Any]
    """(n,) structured, with at least the fields of LIVOX_POINT, read-only view of the message."""


@dataclass(frozen=True)
class CloudFile:
    """A scan in a file of its own; `load` reads and decodes it. Raises InvalidInput when the file is damaged."""

    stamp_ns: int
    receive_ns: int
    load: Callable[[], Cloud]
    path: str = ""


@dataclass(frozen=True)
class ImuSample:
    """Specific force (+9.8 up at rest) and angular rate in the IMU's frame."""

    stamp_ns: int
    receive_ns: int
    gyro_rad_s: tuple[float, float, float]
    accel_m_s2: tuple[float, float, float]
    frame_id: str = "imu"


@dataclass(frozen=True)
class GnssSample:
    """A fix; status as in NavSatStatus, covariance of east, north, up row by row (9 numbers), m2."""

    stamp_ns: int
    receive_ns: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    covariance_m2: tuple[float, ...]
    status: int
    satellites: int = -1
    frame_id: str = "gnss"
    covariance_known: bool = True


@dataclass(frozen=True)
class WheelSample:
    """Speed along x of the base; yaw rate NaN when not given."""

    stamp_ns: int
    receive_ns: int
    speed_m_s: float
    yaw_rate_rad_s: float
    frame_id: str = "base_link"


@dataclass(frozen=True)
class Transform:
    """One edge of the tf tree: coordinates of `child` into `parent`."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: F8


@dataclass(frozen=True)
class Transforms:
    """A tf message."""

    stamp_ns: int
    receive_ns: int
    transforms: tuple[Transform, ...]
    static: bool


@dataclass(frozen=True)
class RawImage:
    """A sensor_msgs/Image as it came, its bytes not copied."""

    stamp_ns: int
    receive_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    is_bigendian: bool
    step: int
    data: NDArray[np.uint8]
    """Read-only; may be shorter or longer than `height * step` (the packer checks)."""


@dataclass(frozen=True)
class CompressedImage:
    """A sensor_msgs/CompressedImage as it came."""

    stamp_ns: int
    receive_ns: int
    frame_id: str
    format: str
    """`jpeg`, `png`, `bayer_rggb8; png compressed`, ...: what the driver wrote, not what the bytes say."""
    data: NDArray[np.uint8]


@dataclass(frozen=True)
class ImageFile:
    """An image in a file of its own."""

    stamp_ns: int
    receive_ns: int
    path: Path
    frame_id: str = ""


@dataclass(frozen=True)
class CameraInfo:
    """A sensor_msgs/CameraInfo; `K`, `R` and `P` row by row."""

    stamp_ns: int
    receive_ns: int
    frame_id: str
    height: int
    width: int
    lens: str
    """The driver's name of the distortion model, for instance `plumb_bob`."""
    distortion: tuple[float, ...]
    K: tuple[float, ...]
    R: tuple[float, ...]
    P: tuple[float, ...]
    binning: tuple[int, int]
    offset_px: tuple[int, int]
    """Upper left corner of the region of interest, in pixels of the whole sensor."""


AnyImage = RawImage | CompressedImage | ImageFile


@dataclass(frozen=True)
class Undecodable:
    """A message of a known type whose bytes do not fit the type; counted and left out."""

    stamp_ns: int
    receive_ns: int
    reason: str


Body = (
    PointCloud2
    | LivoxCloud
    | CloudFile
    | ImuSample
    | GnssSample
    | WheelSample
    | Transforms
    | AnyImage
    | CameraInfo
    | Undecodable
)


class Message(NamedTuple):
    """One record of a log."""

    topic: str
    body: Body


Kind = Literal["cloud", "imu", "gnss", "wheel", "tf", "images", "camera", "other"]


@dataclass(frozen=True)
class TopicInfo:
    """One stream of a log, as far as it is known without decoding."""

    name: str
    type: str
    """ROS 2 style name, for instance `sensor_msgs/msg/PointCloud2`; folder logs use the type that fits."""
    kind: Kind
    count: int
    first_ns: int
    """Receive time of the first message (header time where the log knows no other)."""
    last_ns: int
    period_ns: int
    """Median time between messages; 0 with fewer than two."""
    remark: str = ""


@dataclass
class Damage:
    """What of a log could not be read. Filled while reading; final when `messages` is exhausted."""

    texts: list[str] = field(default_factory=list)
    """Sentences a user understands, each with what was lost."""
    lost_bytes: int = 0

    def __bool__(self) -> bool:
        return bool(self.texts)


class LogSource(Protocol):
    """An open log. Opening reads only what is needed to know the topics."""

    @property
    def format(self) -> str:
        """As `Session.format`: `rosbag1`, `rosbag2`, `mcap`, `kitti raw`, `kitti odometry`, `point files`."""

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """Folder logs name theirs `velodyne_points`, `oxts/imu`, `oxts/gnss`, `scans`, ..."""

    @property
    def extrinsics(self) -> tuple[Extrinsic, ...]:
        """What the log knows besides tf (KITTI calibration); empty for bags."""

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """What the log knows of its cameras besides camera info (KITTI calibration), each by its topic as name."""

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What opening found odd."""

    @property
    def damage(self) -> Damage:
        """What was lost; final after reading."""

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of the given topics in order of receive time, one pass, flat memory.

        A damaged or missing part is noted in `damage` and skipped, never raised.
        """


# Agreed functions of the other modules of this folder:
#
#   pointcloud.decode_pointcloud2(message: PointCloud2) -> Cloud        raises InvalidInput on an impossible layout
#   pointcloud.decode_livox(message: LivoxCloud) -> Cloud
#   pointcloud.azimuth_times(cloud: Cloud, period_ns: int) -> int64 (n,)  ns since the start of the sweep, in [0, period)
#   kitti.open_kitti(raw_log: RawLog) -> LogSource                       both layouts, extrinsics from the calibration
#   pointfiles.open_point_files(raw_log: RawLog, rate_hz: float) -> LogSource
#
# locate.locate gives RawLogs whose names keep the folders below the root: for KITTI raw
# `2011_09_26_drive_0005_sync/velodyne_points/data/0000000000.bin`, `.../oxts/...`, `calib_imu_to_velo.txt` (root is
# the date folder); for KITTI odometry `velodyne/000000.bin`, `times.txt`, `calib.txt` (root is the sequence folder).
