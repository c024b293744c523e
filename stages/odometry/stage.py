"""Odometry: scan to local map, one session at a time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.lookahead import ahead
from scanloom.stages.geometry.rig import corrected
from scanloom.stages.odometry.joining import Tracked, join
from scanloom.stages.odometry.prediction import Predictor
from scanloom.stages.odometry.rows import table
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.thinning import Thinner, ThinScan
from scanloom.stages.odometry.tracker import Tracker
from scanloom.stages.odometry.windows import Window, cut, scans_of, stamps

__all__ = ["VERSION", "Settings", "odometry"]

VERSION = 1

KEPT_SCANS, KEPT_EVERY = 8, 3
"""Of the overlap, so many scans, every third, are registered to the map of the window before."""


def odometry(
    settings: Settings,
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    session: Session,
    imu: Imu,
    wheel: Wheel,
    check: SensorCheck | None = None,
) -> Odometry:
    """Pose of the LiDAR at every scan of one session, in a frame `odom` that is the first scan's LiDAR frame.

    `odom` is not levelled: the first pose is exactly identity, whatever the IMU says of gravity. Motion is predicted
    from gyro and wheels where present, corrected by the scan in the directions it observes, and bridged by prediction
    alone (`reliable` false) where registration failed or the scan is empty. Every scan gets a row. `check` corrects IMU
    and wheels first.

    With `settings.windows` above 1, stretches of the session are tracked at the same time and joined over their overlaps
    (see `joining`); the outcome does not depend on how the threads take turns.

    Raises
    ------
    StageError : fewer than two scans, stamps that do not increase, or labels that do not belong to the scans.
    """
    imu, wheel = corrected(imu, wheel, check)
    windows = (
        cut(stamps(deskewed), settings.windows, settings.window_overlap_s) if settings.windows > 1 else []
    )
    if len(windows) < 2:
        return _tracked(settings, deskewed, labels, session, imu, wheel, None).rows.table()
    with ThreadPoolExecutor(len(windows), thread_name_prefix="window") as threads:
        trackers = list(
            threads.map(lambda w: _tracked(settings, deskewed, labels, session, imu, wheel, w), windows)
        )
    parts = [Tracked(w, t.rows.rows, t.map, t.kept) for w, t in zip(windows, trackers, strict=True)]
    return table(join(settings, parts))


def _tracked(
    settings: Settings, deskewed: Parts[Deskewed], labels: Parts[Labels], session: Session, imu: Imu, wheel: Wheel,
    window: Window | None,
) -> Tracker:  # fmt: skip
    """The session, or a window of it, tracked from its first scan to its last."""
    tracker = Tracker(settings, Predictor(session, imu, wheel), np.array(session.T_base("lidar")))
    rows = tracker.rows
    overlap = window.own - window.first if window else 0
    for scan in ahead(_thinned(settings, deskewed, labels, session.name, window)):
        if len(rows) and scan.stamp_ns <= rows.last_ns:
            raise StageError(
                f"scan {scan.scan_index} is not later than the scan before it",
                where=f"session {session.name}, stamp {scan.stamp_ns} ns",
                next_step="look at the clock of the LiDAR with `scanloom inspect`",
            )
        tracker.step(scan)
        if (
            overlap - KEPT_SCANS * KEPT_EVERY <= len(rows) - 1 < overlap
            and (overlap - len(rows)) % KEPT_EVERY == 0
        ):
            tracker.kept.append((len(rows) - 1, scan.coarse))
    if len(rows) < 2:
        raise StageError(
            f"odometry needs at least two scans, and there are {len(rows)}",
            where=f"session {session.name}",
            next_step="give a longer log",
        )
    return tracker


def _thinned(
    settings: Settings, deskewed: Parts[Deskewed], labels: Parts[Labels], session: str, window: Window | None
) -> Iterator[ThinScan]:
    thinner = Thinner(settings)
    return (thinner.thin(scan, label) for scan, label in scans_of(deskewed, labels, window, session))
