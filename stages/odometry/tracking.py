"""Track: one window of a long session, tracked on its own; odometry joins the tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts, columns_of
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.schemas.windows import Track, TrackEnds, Window
from scanloom.stages.geometry.lookahead import ahead
from scanloom.stages.geometry.rig import corrected
from scanloom.stages.geometry.se3 import F8, inverse, transform
from scanloom.stages.odometry.prediction import Predictor
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.thinning import Thinner
from scanloom.stages.odometry.tracker import Tracker
from scanloom.stages.odometry.windows import scans_of

__all__ = ["VERSION", "Settings", "track", "tracked"]

VERSION = 1

KEPT_SCANS, KEPT_EVERY = 8, 3
"""Of the overlap, so many scans, every third, are registered to the map of the window before."""


@dataclass(frozen=True)
class Kept:
    """Thinned points (n, 3), m, of a scan of the overlap, and its row."""

    row: int
    points: F8


def track(
    settings: Settings,
    window: Window,
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    session: Session,
    imu: Imu,
    wheel: Wheel,
    check: SensorCheck | None = None,
) -> tuple[Track, TrackEnds]:
    """Odometry of the scans of one window, in the frame of its first scan, and what it saw at its ends.

    Only the chunks that hold its scans are read. `check` corrects IMU and wheels first.

    Raises
    ------
    StageError : as `odometry`.
    """
    tracker, kept = tracked(settings, deskewed, labels, session, imu, wheel, check, window)
    rows = tracker.rows.table()
    columns = {name: getattr(rows, name) for name in columns_of(Odometry)}
    return Track(**columns, overlap=window.overlap), _ends(tracker, rows.T_odom_lidar, kept, window.overlap)


def tracked(
    settings: Settings, deskewed: Parts[Deskewed], labels: Parts[Labels], session: Session, imu: Imu, wheel: Wheel,
    check: SensorCheck | None, window: Window | None = None,
) -> tuple[Tracker, list[Kept]]:  # fmt: skip
    """The session, or a window of it, tracked from its first scan to its last, and scans kept of the window's overlap."""
    imu, wheel = corrected(imu, wheel, check)
    tracker = Tracker(settings, Predictor(session, imu, wheel), np.array(session.T_base("lidar")))
    rows, kept, thinner = tracker.rows, list[Kept](), Thinner(settings)
    overlap = window.overlap if window else 0
    for scan in ahead(
        thinner.thin(s, label) for s, label in scans_of(deskewed, labels, window, session.name)
    ):
        if len(rows) and scan.stamp_ns <= rows.last_ns:
            raise StageError(
                f"scan {scan.scan_index} is not later than the scan before it",
                where=f"session {session.name}, stamp {scan.stamp_ns} ns",
                next_step="look at the clock of the LiDAR with `scanloom inspect`",
            )
        tracker.step(scan)
        to_go = overlap - len(rows)
        if 0 <= to_go < KEPT_SCANS * KEPT_EVERY and to_go % KEPT_EVERY == 0:
            kept.append(Kept(len(rows) - 1, scan.coarse))
    if len(rows) < 2:
        raise StageError(
            f"odometry needs at least two scans, and there are {len(rows)}",
            where=f"session {session.name}",
            next_step="give a longer log",
        )
    return tracker, kept


def _ends(tracker: Tracker, T_odom_lidar: F8, kept: Sequence[Kept], overlap: int) -> TrackEnds:
    """Local map and kept scans, by the final poses: each in a LiDAR's frame, near which single precision is enough."""
    end = transform(inverse(T_odom_lidar[-1]), tracker.map.points())
    T_last_odom = inverse(T_odom_lidar[max(overlap - 1, 0)])
    begin = [transform(T_last_odom @ T_odom_lidar[scan.row], scan.points) for scan in kept]
    points = np.concatenate((end, *begin)).astype(np.float32)
    x_m, y_m, z_m = np.ascontiguousarray(points.T)
    return TrackEnds(x_m, y_m, z_m, np.arange(len(points)) < len(end), tracker.map.voxel_size_m)
