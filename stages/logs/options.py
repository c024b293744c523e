"""Settings of ingest: what the user may say about a log that the log does not say itself."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.functional_validators import AfterValidator


def _mounting(values: tuple[float, ...] | None) -> tuple[float, ...] | None:
    if values is not None and (len(values) not in (6, 16) or not all(map(math.isfinite, values))):
        raise ValueError(
            "give 6 numbers (x, y, z in m, roll, pitch, yaw in rad) or 16 (a 4x4 matrix, row by row)"
        )
    return values


Mounting = Annotated[tuple[float, ...] | None, AfterValidator(_mounting)]

_TOPIC = "topic; empty chooses by type and rate, `none` leaves the sensor out"
_MOUNT = "pose on the base: x, y, z (m), roll, pitch, yaw (rad), or a 4x4 matrix row by row; none takes it from the log"
_OFFSET = "added to the stamps to bring them to the LiDAR's clock, s"


class Settings(BaseModel):
    """Which topics, whose clock, how large the chunks."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    lidar_topic: str = Field(default="", description=f"point cloud {_TOPIC}")
    imu_topic: str = Field(default="", description=f"IMU {_TOPIC}")
    gnss_topic: str = Field(default="", description=f"GNSS {_TOPIC}")
    wheel_topic: str = Field(default="", description=f"wheel speed {_TOPIC}")
    scan_rate_hz: float = Field(
        default=10.0, ge=0.5, le=100, description="scan rate of folders of scans, which carry no time, Hz"
    )
    stamp_source: Literal["header", "receive"] = Field(
        default="header", description="stamps of the sensors, or the times of recording"
    )
    point_time: Literal["auto", "azimuth", "none"] = Field(
        default="auto",
        description="auto: from the points, else from azimuth; none: every point has its scan's stamp",
    )
    vertical_correction_deg: float = Field(
        default=0.0,
        ge=-2,
        le=2,
        description="raises every beam; 0.205 for KITTI's HDL-64E (IMLS-SLAM, 2018), deg",
    )
    align_clocks: bool = Field(
        default=True,
        description="shift a sensor whose clock differs from the LiDAR's by more than a second, using receive times",
    )
    imu_offset_s: float = Field(default=0.0, ge=-1e10, le=1e10, description=f"IMU: {_OFFSET}")
    gnss_offset_s: float = Field(default=0.0, ge=-1e10, le=1e10, description=f"GNSS: {_OFFSET}")
    wheel_offset_s: float = Field(default=0.0, ge=-1e10, le=1e10, description=f"wheels: {_OFFSET}")
    lidar_on_base: Mounting = Field(default=None, description=f"LiDAR: {_MOUNT}")
    imu_on_base: Mounting = Field(default=None, description=f"IMU: {_MOUNT}")
    gnss_on_base: Mounting = Field(default=None, description=f"GNSS antenna: {_MOUNT}")
    wheel_on_base: Mounting = Field(default=None, description=f"point whose speed is measured: {_MOUNT}")
    chunk_s: float = Field(default=20.0, ge=1, le=600, description="length of a chunk, s")
    chunk_points: int = Field(
        default=3_000_000,
        ge=1000,
        le=200_000_000,
        description="a chunk ends earlier when it holds this many points",
    )

    def wanted_topics(self) -> dict[str, str]:
        """Topic the user names, by role; empty where it is left to the log."""
        return {
            "lidar": self.lidar_topic, "imu": self.imu_topic, "gnss": self.gnss_topic, "wheel": self.wheel_topic
        }  # fmt: skip

    def mountings(self) -> dict[str, tuple[float, ...]]:
        """Poses on the base that the user gives, by sensor."""
        given = {
            "lidar": self.lidar_on_base, "imu": self.imu_on_base, "gnss": self.gnss_on_base, "wheel": self.wheel_on_base
        }  # fmt: skip
        return {sensor: values for sensor, values in given.items() if values is not None}

    def offset_ns(self, role: str) -> int:
        """What to add to a sensor's stamps."""
        offsets = {"imu": self.imu_offset_s, "gnss": self.gnss_offset_s, "wheel": self.wheel_offset_s}
        return round(offsets.get(role, 0.0) * 1e9)
