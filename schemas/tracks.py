"""Measurements over time: IMU, GNSS, wheel speed. Raw values, kept as they came."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Table, column


@dataclass(frozen=True)
class Imu(Table):
    """Inertial measurements in the IMU's own frame. No rows when the log has none."""

    NAME: ClassVar[str] = "imu"

    stamp_ns: NDArray[np.int64] = column("i8", "time of the measurement", unit="ns")
    gyro_rad_s: NDArray[np.float64] = column("f8", "angular rate", unit="rad/s", shape=(3,), frame="imu")
    accel_m_s2: NDArray[np.float64] = column(
        "f8", "specific force (+9.8 up at rest)", unit="m/s2", shape=(3,), frame="imu"
    )


@dataclass(frozen=True)
class Gnss(Table):
    """Positions from a GNSS receiver with the receiver's own status. No rows when the log has none."""

    NAME: ClassVar[str] = "gnss"

    stamp_ns: NDArray[np.int64] = column("i8", "time of the fix", unit="ns")
    latitude_deg: NDArray[np.float64] = column("f8", "WGS84 latitude; NaN without fix", unit="deg")
    longitude_deg: NDArray[np.float64] = column("f8", "WGS84 longitude; NaN without fix", unit="deg")
    height_m: NDArray[np.float64] = column(
        "f8", "height above the WGS84 ellipsoid; NaN without fix", unit="m"
    )
    covariance_m2: NDArray[np.float64] = column(
        "f8", "receiver's covariance of east, north, up, row by row", unit="m2", shape=(3, 3)
    )
    status: NDArray[np.int8] = column(
        "i1", "NavSatStatus: -1 no fix, 0 fix, 1 satellite-based, 2 ground-based (RTK)"
    )
    satellites: NDArray[np.int16] = column("i2", "satellites used; -1 when the receiver does not tell")


@dataclass(frozen=True)
class Wheel(Table):
    """Speed of the vehicle from its wheels. No rows when the log has none."""

    NAME: ClassVar[str] = "wheel"

    stamp_ns: NDArray[np.int64] = column("i8", "time of the measurement", unit="ns")
    speed_m_s: NDArray[np.float64] = column(
        "f8", "speed along x of the base, negative backwards", unit="m/s", frame="base"
    )
    yaw_rate_rad_s: NDArray[np.float64] = column(
        "f8", "turn rate about z of the base; NaN when not given", unit="rad/s"
    )
