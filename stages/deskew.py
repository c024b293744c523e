"""Deskew: every point of a sweep in the LiDAR frame at one time, the middle of the sweep.

The motion during the sweep comes from gyro and wheels where they are there and sound, else from registering the scan
with its neighbours in the chunk. Source: methods 1.4 (Ren et al. 2021, step b; Xue, Fu and Dai 2019).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.scans import Deskewed, DeskewedScan, Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.compensation import compensate
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.neighbours import ThinScan, twist_between
from scanloom.stages.geometry.se3 import F8

VERSION = 1


class Settings(BaseModel):
    """How motion during the sweep is found."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    motion: Literal["auto", "sensors", "none"] = Field(
        "auto",
        description="source of the motion: sensors, and registration where they are silent (auto); sensors only; or no "
        "compensation at all",
    )
    wheel_scale: float = Field(1.0, ge=0.5, le=2.0, description="true speed over the wheels' speed, ratio")
    max_gyro_gap_s: float = Field(
        0.3, ge=0.0, le=5.0, description="longest pause of the gyro that is bridged by interpolation, s"
    )
    max_wheel_gap_s: float = Field(
        1.0,
        ge=0.0,
        le=10.0,
        description="longest pause of the wheel speed that is bridged by interpolation, s",
    )


def deskew(settings: Settings, scans: Scans, session: Session, imu: Imu, wheel: Wheel) -> Deskewed:
    """The scans of a chunk with all points in the LiDAR frame at each scan's `reference_ns`, m; same points and order.

    Scans are read, compensated and handed on one by one; at most two are held. A scan whose points carry no time of
    their own, or whose motion is not known, passes unchanged; without motion the coordinates are the same bits.
    """
    track = MotionTrack.build(
        imu, wheel, session, wheel_scale=settings.wheel_scale,
        max_gyro_gap_s=settings.max_gyro_gap_s, max_wheel_gap_s=settings.max_wheel_gap_s,
    )  # fmt: skip
    if settings.motion == "none" or session.point_time == "none":
        return Deskewed(_renamed(scan) for scan in scans)
    twists = _Neighbours(track) if settings.motion == "auto" else None
    return Deskewed(_compensated(scans, track, twists))


def _compensated(scans: Scans, track: MotionTrack, neighbours: _Neighbours | None) -> Iterator[DeskewedScan]:
    for scan, following in _with_next(scans):
        twist = neighbours.twist(scan, following) if neighbours else None
        x, y, z = compensate(scan.stamp_ns, scan.x_m, scan.y_m, scan.z_m, scan.reference_ns, track, twist)
        yield _renamed(dataclasses.replace(scan, x_m=x, y_m=y, z_m=z))


class _Neighbours:
    """Twist of each scan from the pairs it forms with the scan before and the scan after, where sensors are silent."""

    def __init__(self, track: MotionTrack) -> None:
        self._track = track
        self._thin: ThinScan | None = None
        self._before: F8 | None = None
        self._last: F8 | None = None

    def twist(self, scan: Scan, following: Scan | None) -> F8 | None:
        """Mean twist of the two pairs, of one at the chunk's ends; the last one known when no pair fits."""
        if self._told(scan) and (following is None or self._told(following)):
            self._thin = self._before = None
            return self._last
        before, after = self._before, self._pair(scan, following)
        known = [twist for twist in (before, after) if twist is not None]
        if known:
            self._last = np.mean(known, axis=0)
        self._before = after
        return self._last

    def _pair(self, scan: Scan, following: Scan | None) -> F8 | None:
        if following is None:
            return None
        near = self._thin if self._thin is not None else ThinScan.of(scan)
        self._thin = ThinScan.of(following)
        return twist_between(
            near, self._thin, self._track, self._last if self._before is None else self._before
        )

    def _told(self, scan: Scan) -> bool:
        if len(scan) == 0:
            return True
        cover = self._track.covers(int(scan.stamp_ns.min()), int(scan.stamp_ns.max()))
        return cover.rotation and cover.translation


def _with_next(scans: Scans) -> Iterator[tuple[Scan, Scan | None]]:
    """Each scan with the one after it, None after the last."""
    current: Scan | None = None
    for scan in scans:
        if current is not None:
            yield current, scan
        current = scan
    if current is not None:
        yield current, None


def _renamed(scan: Scan) -> DeskewedScan:
    fields = {f.name: getattr(scan, f.name) for f in dataclasses.fields(scan)}
    return DeskewedScan(**fields)
