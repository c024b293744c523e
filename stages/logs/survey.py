"""A log on its way through: what every message adds to the picture, and the session that comes out in the end.

Ingest and inspect both feed it, so that what inspect says is what ingest finds.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.session import Extrinsic, Problem, Session, Topic
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.logs.checks import GRAVITY_M_S2, gnss_problems, imu_problems, stamp_problems
from scanloom.stages.logs.mounting import TfTree, resolve
from scanloom.stages.logs.options import Settings
from scanloom.stages.logs.records import (
    GnssSample,
    ImuSample,
    LogSource,
    Message,
    TopicInfo,
    Transforms,
    Undecodable,
    WheelSample,
)
from scanloom.stages.logs.roles import ROLES, Roles
from scanloom.stages.logs.sweeps import ScanTally

I8 = NDArray[np.int64]
_CLOCK_APART_NS = 1_000_000_000
_MOST_SHOWN = 4
_MOST_OF_THE_TIME = 0.9
_LONG_ENOUGH_NS = 3_000_000_000


@dataclass
class _Track:
    """Stamps of one topic in the order of the log."""

    header_ns: array[int] = field(default_factory=lambda: array("q"))
    receive_ns: array[int] = field(default_factory=lambda: array("q"))
    broken: int = 0
    broken_reason: str = ""
    frame: str = ""

    def add(self, header_ns: int, receive_ns: int) -> None:
        self.header_ns.append(header_ns)
        self.receive_ns.append(receive_ns)

    def lag_ns(self) -> float:
        """Median of header minus receive time."""
        return float(np.median(np.subtract(self.header_ns, self.receive_ns))) if self.header_ns else 0.0


class Survey:
    """Takes in the messages of the used topics one by one; clouds are looked at by their headers only."""

    def __init__(self, source: LogSource, roles: Roles, settings: Settings) -> None:
        self.source, self.roles, self.settings = source, roles, settings
        self.tf = TfTree()
        self.tracks = {role: _Track() for role in ROLES}
        self._role = roles.used()
        # plain doubles, row by row: an hour of IMU as objects would be hundreds of megabytes
        self._imu: array[float] = array("d")
        self._gnss: array[float] = array("d")
        self._wheel: array[float] = array("d")

    @property
    def topics(self) -> set[str]:
        """Topics that must be read: those in use, and transforms."""
        return set(self._role) | {topic.name for topic in self.source.topics if topic.kind == "tf"}

    def period_ns(self) -> int:
        """Duration of a sweep, from the rate at which the LiDAR's messages come."""
        found = next((topic.period_ns for topic in self.source.topics if topic.name == self.roles.lidar), 0)
        return found or round(1e9 / self.settings.scan_rate_hz)

    def note(self, message: Message) -> None:
        """Take in one message."""
        body = message.body
        if isinstance(body, Transforms):
            self.tf.note(body)
            return
        role = self._role.get(message.topic)
        if role is None:
            return
        track = self.tracks[role]
        if isinstance(body, Undecodable):
            track.broken += 1
            track.broken_reason = track.broken_reason or body.reason
            return
        if not _finite(body):
            track.broken += 1
            track.broken_reason = track.broken_reason or "values are not finite"
            return
        self._keep(body)
        track.add(body.stamp_ns, body.receive_ns)
        track.frame = track.frame or getattr(body, "frame_id", "")

    def _keep(self, body: object) -> None:
        if isinstance(body, ImuSample):
            self._imu.extend((*body.gyro_rad_s, *body.accel_m_s2))
        elif isinstance(body, GnssSample):
            position = (body.latitude_deg, body.longitude_deg, body.height_m)
            state = (body.status, body.satellites, body.covariance_known)
            self._gnss.extend((*position, *state, *body.covariance_m2))
        elif isinstance(body, WheelSample):
            self._wheel.extend((body.speed_m_s, body.yaw_rate_rad_s))

    # -- products -----------------------------------------------------------------------------------------------------

    def imu(self) -> Imu:
        """All IMU samples in order of time, in SI units."""
        rows = self._ordered("imu")
        values = _table(self._imu, 6)[rows]
        scale = GRAVITY_M_S2 if self._in_g() else 1.0
        return Imu(
            stamp_ns=self._stamps("imu")[rows],
            gyro_rad_s=values[:, :3].copy(),
            accel_m_s2=values[:, 3:] * scale,
        )

    def _in_g(self) -> bool:
        """Some IMUs (Livox, for one) give acceleration in units of gravity."""
        accel = _table(self._imu, 6)[:, 3:]
        return bool(len(accel) and 0.8 < np.linalg.norm(np.median(accel, axis=0)) < 1.2)

    def gnss(self) -> Gnss:
        """All fixes in order of time; position NaN where there is none."""
        rows = self._ordered("gnss")
        values = _table(self._gnss, 15)[rows].copy()
        position, status = values[:, :3], values[:, 3]
        # receivers without fix send zeros
        lost = (status < 0) | ~np.isfinite(position[:, :2]).all(axis=1) | ~position[:, :2].any(axis=1)
        position[lost] = np.nan
        status[lost] = -1
        values[values[:, 5] == 0, 6:] = 0.0
        return Gnss(
            stamp_ns=self._stamps("gnss")[rows],
            latitude_deg=position[:, 0].copy(),
            longitude_deg=position[:, 1].copy(),
            height_m=position[:, 2].copy(),
            covariance_m2=values[:, 6:].reshape(-1, 3, 3).copy(),
            status=status.astype(np.int8),
            satellites=values[:, 4].astype(np.int16),
        )

    def wheel(self) -> Wheel:
        """All wheel speeds in order of time."""
        rows = self._ordered("wheel")
        values = _table(self._wheel, 2)[rows]
        return Wheel(
            stamp_ns=self._stamps("wheel")[rows],
            speed_m_s=values[:, 0].copy(),
            yaw_rate_rad_s=values[:, 1].copy(),
        )

    def _stamps(self, role: str) -> I8:
        """Stamps on the LiDAR's clock, in the order of the log."""
        track = self.tracks[role]
        receive = self.settings.stamp_source == "receive"
        stamps = np.array(track.receive_ns if receive else track.header_ns, np.int64)
        return stamps + self.settings.offset_ns(role) + self._shift_ns(role)

    def _shift_ns(self, role: str) -> int:
        """What brings a sensor with a clock of its own to the LiDAR's clock, from receive times."""
        if (
            not self.settings.align_clocks
            or self.settings.stamp_source == "receive"
            or self.settings.offset_ns(role)
        ):
            return 0
        lidar, sensor = self.tracks["lidar"], self.tracks[role]
        if not lidar.header_ns or not sensor.header_ns:
            return 0
        shift = round(lidar.lag_ns() - sensor.lag_ns())
        return shift if abs(shift) > _CLOCK_APART_NS else 0

    def _ordered(self, role: str) -> I8:
        """Rows in order of time, the first of equal stamps only."""
        return np.unique(self._stamps(role), return_index=True)[1].astype(np.int64)

    # -- summary ------------------------------------------------------------------------------------------------------

    def session(self, name: str, tally: ScanTally, imu: Imu, gnss: Gnss) -> Session:
        """The summary of the log, after its last message."""
        frames = {role: self.tracks[role].frame for role in ROLES if self.tracks[role].header_ns}
        extrinsics, assumed = resolve(self.tf, frames, self.settings.mountings(), self.source.extrinsics)
        stamps = np.unique(self.tracks["lidar"].header_ns)
        period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
        problems = [
            *self._damage(tally),
            *self.source.problems,
            *self.roles.problems,
            *tally.problems,
            *assumed,
            *self._sensor_problems(imu, gnss, extrinsics),
            *self._coverage(tally),
        ]
        return Session(
            name=name,
            format=self.source.format,
            start_ns=tally.first_ns,
            end_ns=tally.last_ns,
            scan_count=tally.scans,
            point_count=tally.points,
            scan_rate_hz=1e9 / period if period else 0.0,
            beams=tally.beams,
            point_time=tally.point_time,
            topics=self._topics(),
            extrinsics=extrinsics,
            problems=tuple(problems),
            complete=not self.source.damage and not any(track.broken for track in self.tracks.values()),
        )

    def _damage(self, tally: ScanTally) -> Iterator[Problem]:
        damage = self.source.damage
        if not damage:
            return
        shown = damage.texts[:_MOST_SHOWN]
        more = f"; and {len(damage.texts) - len(shown)} more places" if len(damage.texts) > len(shown) else ""
        text = (
            f"The log is incomplete: {'; '.join(shown)}{more}. {tally.scans} scans over "
            f"{(tally.last_ns - tally.first_ns) / 1e9:.1f} s can be read."
        )
        yield Problem(code="log.incomplete", severity="warning", text=text)

    def _sensor_problems(self, imu: Imu, gnss: Gnss, extrinsics: Sequence[Extrinsic]) -> Iterator[Problem]:
        starts = [self.tracks["lidar"].header_ns[0]] if self.tracks["lidar"].header_ns else []
        for role in ROLES:
            topic, track = self.roles.of(role), self.tracks[role]
            header = np.array(track.header_ns, np.int64)
            start = (
                starts[0] if starts and not self._shift_ns(role) else (int(header[0]) if len(header) else 0)
            )
            yield from stamp_problems(role, topic, header, np.array(track.receive_ns, np.int64), start)
            if track.broken:
                text = f"{track.broken} messages of {topic} cannot be used ({track.broken_reason}) and are left out."
                yield Problem(code=f"{role}.broken", severity="warning", text=text, topic=topic)
            if shift := self._shift_ns(role):
                text = (
                    f"{topic} is stamped by another clock than the LiDAR. Its stamps are shifted by {shift / 1e9:.3f} s, "
                    f"as the times of recording suggest (good to some milliseconds); give ingest.{role}_offset_s if you know."
                )
                yield Problem(code=f"{role}.clock_shifted", severity="warning", text=text, topic=topic)
        yield from self._imu_problems(imu, extrinsics)
        yield from gnss_problems(gnss, self.roles.gnss)

    def _imu_problems(self, imu: Imu, extrinsics: Sequence[Extrinsic]) -> Iterator[Problem]:
        mounted = next((e for e in extrinsics if e.sensor == "imu"), None)
        if mounted is None:
            return
        R = np.array(mounted.T_base_sensor)[:3, :3]
        yield from imu_problems(imu, self.roles.imu, R, mounted.source != "assumed identity")
        if self._in_g():
            text = f"{self.roles.imu} gives acceleration in units of gravity; it is multiplied by {GRAVITY_M_S2}."
            yield Problem(code="imu.units_g", severity="info", text=text, topic=self.roles.imu)

    def _coverage(self, tally: ScanTally) -> Iterator[Problem]:
        """Sensors that do not measure while the LiDAR does."""
        span_ns = max(tally.last_ns - tally.first_ns, 1)
        for role in ("imu", "gnss", "wheel"):
            stamps, topic = self._stamps(role), self.roles.of(role)
            if not len(stamps) or not tally.scans:
                continue
            shared = (
                min(int(stamps.max()), tally.last_ns) - max(int(stamps.min()), tally.first_ns)
            ) / span_ns
            if shared < 0:
                text = f"{topic} does not overlap the LiDAR's scans in time; check the clocks or ingest.{role}_offset_s."
                yield Problem(code=f"{role}.no_overlap", severity="warning", text=text, topic=topic)
            elif shared < _MOST_OF_THE_TIME and span_ns > _LONG_ENOUGH_NS:
                text = f"{topic} covers only {100 * shared:.0f} % of the time in which the LiDAR measures."
                yield Problem(code=f"{role}.partial", severity="warning", text=text, topic=topic)

    def _topics(self) -> tuple[Topic, ...]:
        return tuple(
            Topic(
                name=topic.name,
                type=topic.type,
                role=_role(self._role.get(topic.name), topic.kind),
                messages=topic.count,
                rate_hz=_rate_hz(topic),
                first_ns=topic.first_ns,
                last_ns=topic.last_ns,
                remark=topic.remark,
            )
            for topic in self.source.topics
        )


def _finite(body: object) -> bool:
    """Whether an IMU or wheel sample is a number; a missing yaw rate is none."""
    if isinstance(body, ImuSample):
        return all(map(math.isfinite, (*body.gyro_rad_s, *body.accel_m_s2)))
    return not isinstance(body, WheelSample) or math.isfinite(body.speed_m_s)


def _table(values: array[float], width: int) -> F8:
    return np.array(values, np.float64).reshape(-1, width)


TopicRole = Literal["lidar", "imu", "gnss", "wheel", "images", "camera", "tf", "unused"]


def _role(used: str | None, kind: str) -> TopicRole:
    for role in ("lidar", "imu", "gnss", "wheel"):
        if used == role:
            return role
    for other in ("tf", "images", "camera"):
        if kind == other:
            return other
    return "unused"


def _rate_hz(topic: TopicInfo) -> float:
    """Mean rate; bursts do not raise it."""
    span_ns = topic.last_ns - topic.first_ns
    return (topic.count - 1) * 1e9 / span_ns if span_ns > 0 else 0.0
