"""Deskew: every point of a sweep in the LiDAR frame at one time, the middle of the sweep.

The motion during the sweep comes from gyro and wheels where they are there and sound, else from registering the scan
with its neighbours in the chunk. Source: methods 1.4 (Ren et al. 2021, step b; Xue, Fu and Dai 2019).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, DeskewedScan, Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.compensation import F4, compensate
from scanloom.stages.geometry.motion import MotionTrack, Twists
from scanloom.stages.geometry.neighbours import ThinScan, twist_between
from scanloom.stages.geometry.rig import corrected
from scanloom.stages.geometry.se3 import F8

VERSION = 2
REMEMBERED_NS = 500_000_000


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


def deskew(
    settings: Settings,
    scans: Scans,
    session: Session,
    imu: Imu,
    wheel: Wheel,
    check: SensorCheck | None = None,
) -> Deskewed:
    """The scans of a chunk with all points in the LiDAR frame at each scan's `reference_ns`, m; same points and order.

    Scans are read, compensated and handed on one by one; at most two are held. A scan whose points carry no time of
    their own, or whose motion is not known, passes unchanged; without motion the coordinates are the same bits.
    `check` corrects IMU and wheels first.
    """
    track = MotionTrack.build(
        *corrected(imu, wheel, check), session, wheel_scale=settings.wheel_scale,
        max_gyro_gap_s=settings.max_gyro_gap_s, max_wheel_gap_s=settings.max_wheel_gap_s,
    )  # fmt: skip
    if settings.motion == "none" or session.point_time == "none":
        return Deskewed(_seen_at_once(scan, scan.x_m, scan.y_m, scan.z_m) for scan in scans)
    twists = _Neighbours(track) if settings.motion == "auto" else None
    return Deskewed(_compensated(scans, track, twists))


def _compensated(scans: Scans, track: MotionTrack, neighbours: _Neighbours | None) -> Iterator[DeskewedScan]:
    for scan, following in _with_next(scans):
        twist = neighbours.twist(scan, following) if neighbours else None
        x, y, z = compensate(scan.stamp_ns, scan.x_m, scan.y_m, scan.z_m, scan.reference_ns, track, twist)
        found = neighbours.following if neighbours else None
        yield _seen_at_once(scan, x, y, z, () if found is None else tuple(found.twist.tolist()))


class Pair(NamedTuple):
    """Two neighbouring scans: the twist (6,) between them and the time in the middle."""

    middle_ns: int
    twist: F8


class _Neighbours:
    """Twist of each scan from the pairs it forms with the scan before and the scan after, where sensors are silent."""

    def __init__(self, track: MotionTrack) -> None:
        self._track = track
        self._thin: ThinScan | None = None
        self.following: Pair | None = None
        """Of the last scan and the one after it, if they were registered."""
        self._last: Twists | None = None

    def twist(self, scan: Scan, following: Scan | None) -> Twists | None:
        """Twists of the two pairs, of one at the chunk's ends; the last known for a while when no pair fits.

        Each holds in the middle between its two scans: a motion that changes during the sweep is followed.
        """
        if self._told(scan) and (following is None or self._told(following)):
            self._thin = self.following = None
            return self._recent(scan)
        before, after = self.following, self._pair(scan, following)
        known = [pair for pair in (before, after) if pair is not None]
        if known:
            self._last = Twists(np.array([p.middle_ns for p in known]), np.array([p.twist for p in known]))
        self.following = after
        return self._recent(scan)

    def _recent(self, scan: Scan) -> Twists | None:
        """The last twists that were found, unless they say nothing of this scan any more."""
        if self._last is None or scan.reference_ns - int(self._last.stamp_ns[-1]) > REMEMBERED_NS:
            return None
        return self._last

    def _pair(self, scan: Scan, following: Scan | None) -> Pair | None:
        if following is None:
            return None
        near = self._thin if self._thin is not None else ThinScan.of(scan)
        self._thin = ThinScan.of(following)
        guess = self.following.twist if self.following is not None else None
        if guess is None and self._last is not None:
            guess = self._last.value[-1]
        twist = twist_between(near, self._thin, self._track, guess)
        return None if twist is None else Pair((near.reference_ns + self._thin.reference_ns) // 2, twist)

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


def _seen_at_once(scan: Scan, x: F4, y: F4, z: F4, next_twist: tuple[float, ...] = ()) -> DeskewedScan:
    return DeskewedScan(
        x_m=x, y_m=y, z_m=z, intensity=scan.intensity, reference_ns=scan.reference_ns, scan_index=scan.scan_index,
        next_twist=next_twist,
    )  # fmt: skip
