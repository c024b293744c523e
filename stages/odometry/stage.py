"""Odometry: scan to local map, one session at a time, or joined from the tracks of its windows."""

from __future__ import annotations

from collections.abc import Sequence

from scanloom.schemas.product import Parts
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.schemas.windows import Track, TrackEnds
from scanloom.stages.odometry.joining import join
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.tracking import tracked

__all__ = ["VERSION", "Settings", "odometry"]

VERSION = 1


def odometry(
    settings: Settings,
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    session: Session,
    imu: Imu,
    wheel: Wheel,
    check: SensorCheck | None = None,
    tracks: Sequence[Track] = (),
    ends: Sequence[TrackEnds] = (),
) -> Odometry:
    """Pose of the LiDAR at every scan of one session, in a frame `odom` that is the first scan's LiDAR frame.

    `odom` is not levelled: the first pose is exactly identity, whatever the IMU says of gravity. Motion is predicted
    from gyro and wheels where present, corrected by the scan in the directions it observes, and bridged by prediction
    alone (`reliable` false) where registration failed or the scan is empty. Every scan gets a row. `check` corrects IMU
    and wheels first.

    Where the session was cut into windows, `tracks` and `ends` are theirs, in order, and are joined over their overlaps
    (see `joining`); the scans are not read again.

    Raises
    ------
    StageError : fewer than two scans, stamps that do not increase, or labels that do not belong to the scans.
    """
    if len(tracks):
        return join(settings, tracks, ends)
    tracker, _ = tracked(settings, deskewed, labels, session, imu, wheel, check)
    return tracker.rows.table()
