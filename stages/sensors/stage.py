"""Sensors: IMU and wheels of a session held against the motion between its scans.

A few short stretches are looked at, those in which the sensors have most to say. There neighbouring scans are
registered with each other and with nothing else, and the turn rates and speeds that result are compared with the
readings. Where the evidence is clear, wrong clocks, units, axes, and the wheels' scale are corrected.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.product import Parts
from scanloom.schemas.rig import ImuCheck, SensorCheck, WheelCheck
from scanloom.schemas.scans import Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.rig import corrected
from scanloom.stages.geometry.se3 import F8, adjoint
from scanloom.stages.sensors.agreement import Seen, seconds
from scanloom.stages.sensors.inertial import check_imu
from scanloom.stages.sensors.stretches import STRETCH, Motions, Place, liveliest, motions, places
from scanloom.stages.sensors.wheels import check_wheel

VERSION = 1
Check = TypeVar("Check", ImuCheck, WheelCheck)
LEAST_STRETCHES = 2


class Settings(BaseModel):
    """How thoroughly the sensors are checked."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    correct: bool = Field(True, description="whether what is clearly wrong is corrected, or only reported")
    max_clock_offset_s: float = Field(
        0.5, ge=0.05, le=2.0, description="largest error of a clock that is searched for, s"
    )
    stretches: int = Field(
        5, ge=0, le=50, description="stretches of 12 pairs of scans that are looked at; 0 for no check at all"
    )
    points: int = Field(
        4_000_000,
        ge=100_000,
        le=1_000_000_000,
        description="scans of many points are looked at in fewer stretches, at least two: points read in all",
    )


def sensors(settings: Settings, scans: Parts[Scans], session: Session, imu: Imu, wheel: Wheel) -> SensorCheck:
    """What is wrong with the session's IMU and wheels, by its own scans.

    Nothing is read where there is neither IMU nor wheel speed. Readings that fit in no known way are left as they are.
    """
    if settings.stretches == 0 or (len(imu) < 2 and len(wheel) < 2):
        return SensorCheck(imu=ImuCheck(), wheel=WheelCheck())
    parts = [*scans]
    where = places(parts)
    starts = _starts(settings, where, imu, wheel)
    found = motions(parts, where, starts, MotionTrack.build(Imu.empty(), Wheel.empty(), session))
    stood = len(MotionTrack.build(imu, wheel, session).standstill) > 0
    limit = settings.max_clock_offset_s
    T_base_imu = np.array(session.T_base("imu"))
    imu_check, said_of_imu = check_imu(imu, _turn_rates(found, session), T_base_imu, limit, stood)
    if len(wheel) > 1 and imu_check.verdict in ("agrees", "corrected"):
        gyro = corrected(imu, Wheel.empty(), SensorCheck(imu=imu_check))
        found = found.again(MotionTrack.build(*gyro, session))
    wheel_check, said_of_wheel = check_wheel(wheel, _speeds(found, session), limit)
    if not settings.correct:
        imu_check, wheel_check = _neutral(imu_check), _neutral(wheel_check)
    return SensorCheck(imu=imu_check, wheel=wheel_check, remarks=(*said_of_imu, *said_of_wheel))


def _starts(settings: Settings, where: list[Place], imu: Imu, wheel: Wheel) -> list[int]:
    """Stretches in which the vehicle turns and brakes most: half of them by the gyro, half by the wheels."""
    each = max(sum(place.points for place in where) / max(len(where), 1), 1.0)
    count = int(min(settings.stretches, max(LEAST_STRETCHES, settings.points / (each * STRETCH))))
    reference_ns = np.array([place.reference_ns for place in where], np.int64)
    taken: set[int] = set()
    by_wheel = 0 if len(wheel) < 2 else count if len(imu) < 2 else count // 2
    gyro = np.nan_to_num(imu.gyro_rad_s)
    starts = liveliest(reference_ns, imu.stamp_ns, gyro, count - by_wheel, taken)
    return starts + liveliest(
        reference_ns, wheel.stamp_ns, np.nan_to_num(wheel.speed_m_s)[:, None], by_wheel, taken
    )


def _turn_rates(found: Motions, session: Session) -> Seen:
    """(m, 3) in the base frame, rad/s."""
    return _seen(found, _base_twists(found, session)[:, :3])


def _speeds(found: Motions, session: Session) -> Seen:
    """(m, 1) of the wheels' place along x of the base, m/s."""
    twist, wheel_position = _base_twists(found, session), np.array(session.T_base("wheel"))[:3, 3]
    velocity = twist[:, 3:] + np.cross(twist[:, :3], wheel_position)
    return _seen(found, velocity[:, :1])


def _base_twists(found: Motions, session: Session) -> F8:
    twist: F8 = found.twist @ adjoint(np.array(session.T_base("lidar"))).T
    return twist


def _seen(found: Motions, value: F8) -> Seen:
    return Seen(seconds(found.start_ns), seconds(found.end_ns), value)


def _neutral(check: Check) -> Check:
    """The same findings without corrections."""
    measured = {
        name for name in type(check).model_fields if name.startswith(("measured", "correlation", "scan"))
    }
    kept = {name: getattr(check, name) for name in measured}
    verdict = "unknown" if check.verdict == "corrected" else check.verdict
    return type(check)(verdict=verdict, **kept)
