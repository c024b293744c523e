"""Objects: tracks of what moves among the scenery (methods 1.5.1; Ren et al. 2021, step c)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, ScanLabels
from scanloom.schemas.session import Session
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.geometry.spacing import azimuth_step_rad
from scanloom.stages.objects.paths import ObjectPath, object_path
from scanloom.stages.objects.settings import Settings
from scanloom.stages.objects.tracker import History, Tracker
from scanloom.stages.objects.virtual_scan import virtual_scan

VERSION = 1

USUAL_HEIGHT_M = 1.8


def objects(
    settings: Settings, deskewed: Parts[Deskewed], labels: Parts[Labels], session: Session, odometry: Odometry
) -> ObjectTracks:
    """Boxes of everything that moved in a session, in the frame of its odometry, segment by segment.

    Scans stream through one by one; what is kept is a few of them and the tracks. Scans without pose are passed over.
    """
    T_base_lidar = np.array(session.T_base("lidar"), float)
    T_level_odom = np.eye(4)
    T_level_odom[:3, :3] = T_base_lidar[:3, :3]
    limits = (settings.lowest_m, settings.highest_m, settings.max_range_m)
    under = -float(T_base_lidar[2, 3]) or -USUAL_HEIGHT_M
    tracker, segment = Tracker(settings), -1
    paths: list[ObjectPath] = []
    for row, scan, label in _posed(deskewed, labels, odometry):
        if odometry.segment[row] != segment:
            paths += _paths(settings, tracker.finish(), odometry)
            tracker, segment = Tracker(settings), int(odometry.segment[row])
        seen = virtual_scan(
            scan.x_m, scan.y_m, scan.z_m, label.class_, T_level_odom @ odometry.T_odom_lidar[row], under, limits
        )  # fmt: skip
        ended = tracker.step(
            seen, scan.reference_ns, scan.scan_index, azimuth_step_rad(len(scan), session.beams)
        )
        paths += _paths(settings, ended, odometry)
    paths += _paths(settings, tracker.finish(), odometry)
    return table(paths, odometry, T_level_odom)


def _posed(
    deskewed: Parts[Deskewed], labels: Parts[Labels], odometry: Odometry
) -> Iterator[tuple[int, DeskewedScan, ScanLabels]]:
    """Scans with their labels and their row of the odometry."""
    for scans, classes in zip(deskewed, labels, strict=True):
        for scan, label in zip(scans, classes, strict=True):
            row = int(np.searchsorted(odometry.scan_index, scan.scan_index))
            if row < len(odometry) and odometry.scan_index[row] == scan.scan_index:
                yield row, scan, label


def _paths(settings: Settings, histories: list[History], odometry: Odometry) -> list[ObjectPath]:
    found = (object_path(settings, each, odometry.scan_index, odometry.stamp_ns) for each in histories)
    return [path for path in found if path is not None]


def table(paths: list[ObjectPath], odometry: Odometry, T_level_odom: F8) -> ObjectTracks:
    """All paths as one table, by scan and track; tracks are numbered by their first scan."""
    if not paths:
        return ObjectTracks.empty()
    paths = sorted(paths, key=lambda path: (int(path.rows[0]), *path.xyz[0]))
    rows = np.concatenate([path.rows for path in paths])
    counts = [len(path.rows) for path in paths]
    T_odom_object = inverse(T_level_odom) @ np.concatenate([_placed(path) for path in paths])
    size = np.repeat([path.size for path in paths], counts, axis=0)
    whole = ObjectTracks(
        scan_index=odometry.scan_index[rows],
        stamp_ns=odometry.stamp_ns[rows],
        track=np.repeat(np.arange(len(paths), dtype=np.int32), counts),
        T_odom_object=T_odom_object,
        T_lidar_object=inverse(odometry.T_odom_lidar[rows]) @ T_odom_object,
        length_m=size[:, 0],
        width_m=size[:, 1],
        height_m=size[:, 2],
        speed_m_s=np.concatenate([path.speed_m_s for path in paths]),
        class_=np.repeat(np.array([path.kind for path in paths], np.uint8), counts),
        dynamic=np.concatenate([path.dynamic for path in paths]),
        score=np.repeat([path.score for path in paths], counts),
    )
    return whole.take(np.lexsort((whole.track, whole.scan_index)))


def _placed(path: ObjectPath) -> NDArray[np.float64]:
    """T_level_object (n, 4, 4)."""
    T = np.tile(np.eye(4), (len(path.rows), 1, 1))
    c, s = np.cos(path.yaw), np.sin(path.yaw)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, :3, 3] = path.xyz
    return T
