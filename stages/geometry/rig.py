"""The sensors of a session with the corrections that its own scans ask for."""

from __future__ import annotations

import dataclasses

import numpy as np

from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.tracks import Imu, Wheel


def corrected(imu: Imu, wheel: Wheel, check: SensorCheck | None) -> tuple[Imu, Wheel]:
    """IMU and wheel speed on the LiDAR's clock, in SI units and the declared axes; unchanged where nothing is wrong."""
    if check is None:
        return imu, wheel
    return _imu(imu, check), _wheel(wheel, check)


def _imu(imu: Imu, check: SensorCheck) -> Imu:
    c = check.imu
    if len(imu) == 0 or c.verdict != "corrected":
        return imu
    gyro = c.gyro_factor * imu.gyro_rad_s @ np.array(c.gyro_axes).T - np.array(c.gyro_bias_rad_s)
    accel = c.accel_factor * imu.accel_m_s2 @ np.array(c.accel_axes).T
    return Imu(imu.stamp_ns - round(c.clock_offset_s * 1e9), gyro, accel)


def _wheel(wheel: Wheel, check: SensorCheck) -> Wheel:
    c = check.wheel
    if len(wheel) == 0 or c.verdict != "corrected":
        return wheel
    return dataclasses.replace(
        wheel,
        stamp_ns=wheel.stamp_ns - round(c.clock_offset_s * 1e9),
        speed_m_s=wheel.speed_m_s * (c.factor * c.scale),
    )
