"""What a session's own scans say of its other sensors: clock, units, axes, scale."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict

from scanloom.schemas.product import Document

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
AS_GIVEN: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

Verdict = Literal["absent", "unknown", "agrees", "corrected", "contradicts"]
"""`unknown`: the motion gives no evidence; `contradicts`: the sensor fits in no way that is known, and is left as it is."""


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ImuCheck(_Entry):
    """Corrections of the IMU, neutral where nothing is wrong or nothing is known, and what they rest on."""

    verdict: Verdict = "absent"
    clock_offset_s: float = 0.0
    """How much later its stamps are than the LiDAR's clock; to be subtracted."""
    gyro_factor: float = 1.0
    """rad/s per unit of the gyro."""
    gyro_axes: Matrix3 = AS_GIVEN
    """Rows: the axes of the IMU's frame by those of its readings."""
    gyro_bias_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the IMU's frame, after the other corrections; zero where the vehicle stood, since rest tells it better."""
    accel_factor: float = 1.0
    """m/s2 per unit of the accelerometer."""
    accel_axes: Matrix3 = AS_GIVEN
    measured_offset_s: float = float("nan")
    measured_offset_std_s: float = float("nan")
    correlation: float = float("nan")
    """Of its turn rates, corrected, with those between scans."""
    correlation_as_given: float = float("nan")
    scan_pairs: int = 0


class WheelCheck(_Entry):
    """Corrections of the wheel speed, and what they rest on."""

    verdict: Verdict = "absent"
    clock_offset_s: float = 0.0
    factor: float = 1.0
    """m/s per unit, negative when it counts backwards."""
    scale: float = 1.0
    """True speed over the wheels' speed after that."""
    measured_offset_s: float = float("nan")
    measured_offset_std_s: float = float("nan")
    measured_ratio: float = float("nan")
    measured_ratio_std: float = float("nan")
    scan_pairs: int = 0


class SensorCheck(Document):
    """IMU and wheels of a session held against the motion between its scans."""

    NAME: ClassVar[str] = "sensor_check"

    imu: ImuCheck = ImuCheck()
    wheel: WheelCheck = WheelCheck()
    remarks: tuple[str, ...] = ()
    """What was found, in sentences."""
