"""Odometry: scan to local map, one session at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.odometry.prediction import Predictor
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.tracker import Row, Tracker

__all__ = ["VERSION", "Settings", "odometry"]

VERSION = 1
USED = (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC)
USED_CLASS = np.isin(np.arange(256), USED)


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
    rows: list[Row] = []
    for scan, label in _pairs(deskewed, labels, session.name):
        if rows and scan.reference_ns <= rows[-1].stamp_ns:
            raise StageError(
                f"scan {scan.scan_index} is not later than the scan before it",
                where=f"session {session.name}, stamp {scan.reference_ns} ns",
                next_step="look at the clock of the LiDAR with `scanloom inspect`",
            )
        rows.append(tracker.step(scan.scan_index, scan.reference_ns, used_points(scan, label)))
    if len(rows) < 2:
        raise StageError(
            f"odometry needs at least two scans, and there are {len(rows)}",
            where=f"session {session.name}",
            next_step="give a longer log",
        )
    return _table(rows)


def used_points(scan: DeskewedScan, labels: ScanLabels) -> NDArray[np.float32]:
    """Points (n, 3) that may be part of the static world, in the LiDAR frame, m."""
    return scan.points()[USED_CLASS[labels.class_]]


def _pairs(
    deskewed: Parts[Deskewed], labels: Parts[Labels], session: str
) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    for scans, scan_labels in zip(deskewed, labels, strict=True):
        for scan, label in zip(scans, scan_labels, strict=True):
            if len(scan) != len(label) or scan.scan_index != label.scan_index:
                raise StageError(
                    f"labels of scan {label.scan_index} do not belong to scan {scan.scan_index}",
                    where=f"session {session}",
                    next_step="run `scanloom verify`, then map again",
                )
            yield scan, label


def _table(rows: list[Row]) -> Odometry:
    return Odometry(
        scan_index=np.array([r.scan_index for r in rows], np.int64),
        stamp_ns=np.array([r.stamp_ns for r in rows], np.int64),
        T_odom_lidar=np.array([r.T_odom_lidar for r in rows]),
        covariance=np.array([r.covariance for r in rows]),
        inlier_ratio=np.array([r.inlier_ratio for r in rows]),
        rmse_m=np.array([r.rmse_m for r in rows]),
        degeneracy_d=np.array([r.seen.d for r in rows]),
        degeneracy_e=np.array([r.seen.e_m for r in rows]),
        direction_p=np.array([r.seen.p for r in rows]),
        weak_directions=np.array([r.seen.directions for r in rows]),
        keyframe=np.array([r.keyframe for r in rows]),
        reliable=np.array([r.reliable for r in rows]),
    )
