"""Odometry: scan to local map, one session at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.lookahead import ahead
from scanloom.stages.odometry.prediction import Predictor
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.thinning import ThinScan, thin
from scanloom.stages.odometry.tracker import Tracker

__all__ = ["VERSION", "Settings", "odometry"]

VERSION = 1


def odometry(
    settings: Settings,
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    session: Session,
    imu: Imu,
    wheel: Wheel,
) -> Odometry:
    """Pose of the LiDAR at every scan of one session, in a frame `odom` that is the first scan's LiDAR frame.

    `odom` is not levelled: the first pose is exactly identity, whatever the IMU says of gravity. Motion is predicted
    from gyro and wheels where present, corrected by the scan in the directions it observes, and bridged by prediction
    alone (`reliable` false) where registration failed or the scan is empty. Every scan gets a row.

    Raises
    ------
    StageError : fewer than two scans, stamps that do not increase, or labels that do not belong to the scans.
    """
    predictor = Predictor(session, imu, wheel)
    tracker = Tracker(settings, predictor, np.array(session.T_base("lidar")))
    rows = tracker.rows
    for scan in ahead(_thinned(settings, deskewed, labels, session.name)):
        if len(rows) and scan.stamp_ns <= rows.last_ns:
            raise StageError(
                f"scan {scan.scan_index} is not later than the scan before it",
                where=f"session {session.name}, stamp {scan.stamp_ns} ns",
                next_step="look at the clock of the LiDAR with `scanloom inspect`",
            )
        tracker.step(scan)
    if len(rows) < 2:
        raise StageError(
            f"odometry needs at least two scans, and there are {len(rows)}",
            where=f"session {session.name}",
            next_step="give a longer log",
        )
    return rows.table()


def _thinned(
    settings: Settings, deskewed: Parts[Deskewed], labels: Parts[Labels], session: str
) -> Iterator[ThinScan]:
    for scans, scan_labels in zip(deskewed, labels, strict=True):
        for scan, label in zip(scans, scan_labels, strict=True):
            if len(scan) != len(label) or scan.scan_index != label.scan_index:
                raise StageError(
                    f"labels of scan {label.scan_index} do not belong to scan {scan.scan_index}",
                    where=f"session {session}",
                    next_step="run `scanloom verify`, then map again",
                )
            yield thin(settings, scan, label)
