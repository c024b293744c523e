"""The session: what a log holds, what of it is used, and what is odd about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict

from scanloom.schemas.product import Document, Files

Severity = Literal["info", "warning", "error"]
Matrix4 = tuple[tuple[float, float, float, float], ...]
IDENTITY: Matrix4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True)
class RawLog(Files):
    """The log as it came: the only thing a stage reads that the pipeline did not write."""

    NAME: ClassVar[str] = "raw_log"


@dataclass(frozen=True)
class TruthLog(Files):
    """Files with the true trajectory, for evaluation only. Empty when there is no truth."""

    NAME: ClassVar[str] = "truth_log"


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Topic(_Entry):
    """One stream of a log."""

    name: str
    type: str
    role: Literal["lidar", "imu", "gnss", "wheel", "images", "camera", "tf", "unused"]
    """`camera` holds models of cameras (camera info), `images` what they saw."""
    messages: int
    rate_hz: float
    first_ns: int
    last_ns: int
    remark: str = ""


class Problem(_Entry):
    """Something odd in a log: what, where, and how bad."""

    code: str
    """Stable dotted name, for instance `imu.gap`."""
    severity: Severity
    text: str
    topic: str = ""
    stamp_ns: int = 0


class Extrinsic(_Entry):
    """Pose of one sensor on the vehicle."""

    sensor: Literal["lidar", "imu", "gnss", "wheel"]
    T_base_sensor: Matrix4
    source: str
    """Where the numbers come from: `tf`, `session file`, `kitti calibration`, `assumed identity`."""


class Session(Document):
    """A log: sensors, topics, time range, extrinsics, counts, problems found."""

    NAME: ClassVar[str] = "session"

    name: str
    format: str
    """`rosbag1`, `rosbag2`, `mcap`, `kitti raw`, `kitti odometry`, `point files`."""
    start_ns: int
    end_ns: int
    scan_count: int
    point_count: int
    scan_rate_hz: float
    beams: int
    point_time: Literal["per point", "from azimuth", "none"]
    """Where the per-point time comes from; `none` when every point carries the stamp of its scan."""
    topics: tuple[Topic, ...]
    extrinsics: tuple[Extrinsic, ...]
    problems: tuple[Problem, ...]
    complete: bool
    """False when the log was truncated or damaged and only part of it could be read."""

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.start_ns) * 1e-9

    def T_base(self, sensor: str) -> Matrix4:
        """Pose of a sensor on the vehicle; identity when the log does not tell."""
        for extrinsic in self.extrinsics:
            if extrinsic.sensor == sensor:
                return extrinsic.T_base_sensor
        return IDENTITY
