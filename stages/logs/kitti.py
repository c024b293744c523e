"""KITTI folders as logs: raw drives (scans with GNSS/INS beside them) and odometry sequences.

Source: Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013, and its development kit.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import Problem, RawLog
from scanloom.stages.geometry.sweep import CLOCKWISE, Sweep, rings_by_wrap
from scanloom.stages.logs.folder import FolderLog, problem, ranges
from scanloom.stages.logs.kitti_cameras import odometry_cameras, odometry_images, raw_cameras, raw_images
from scanloom.stages.logs.oxts import (
    GNSS,
    IMU,
    extrinsics,
    gnss_samples,
    imu_samples,
    read_oxts,
    read_seconds,
    read_T_velo_imu,
    read_timestamps,
)
from scanloom.stages.logs.records import Cloud, CloudFile

SCANS = "velodyne_points"
SCAN_PERIOD_NS = 100_000_000
POINT_BYTES = 16
"""x, y, z in m and reflectance 0 to 1, float32 little-endian."""
HDL64_SWEEP = Sweep(CLOCKWISE, np.pi, in_firing_order=False, detected=True)
"""Clockwise from the rear, so that the middle of the sweep, which the stamp names, looks ahead. The files store each
beam by rising azimuth, which hides the order of firing; the test on drive 0005 shows that this one fits the motion."""
_RAW_SCAN = re.compile(r"(?P<drive>.*/|)velodyne_points/data/(?P<number>\d+)\.bin$")
_ODOMETRY_SCAN = re.compile(r"(?P<drive>.*/|)velodyne/(?P<number>\d+)\.bin$")


LoadScan = Callable[[Path, int], Cloud]


def open_kitti(raw_log: RawLog) -> FolderLog:
    """A KITTI raw drive or odometry sequence.

    Raises
    ------
    InvalidInput : the folder has no scans, or none that can be read.
    """
    for pattern, opener in ((_RAW_SCAN, _open_raw), (_ODOMETRY_SCAN, _open_odometry)):
        found = [match for name in raw_log.names if (match := pattern.match(name))]
        if found:
            return opener(raw_log, found)
    raise InvalidInput(
        "no scans in this KITTI folder",
        where=str(raw_log.root or ""),
        next_step="give the folder of a drive with velodyne_points/data/*.bin, or of a sequence with velodyne/*.bin",
    )


def read_velodyne(
    path: Path, stamp_ns: int, sweep: Sweep | None = HDL64_SWEEP, beams: int | None = 64
) -> Cloud:
    """One `.bin` scan. Bytes past the last whole point are left out. Times are not set; beams follow from the order.

    Raises
    ------
    InvalidInput : the file cannot be read or holds no whole point.
    """
    try:
        raw = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InvalidInput(f"cannot be read: {error.strerror}", where=str(path)) from error
    count = len(raw) // POINT_BYTES
    if count == 0:
        raise InvalidInput(f"holds no point ({len(raw)} bytes)", where=str(path))
    points = raw[: count * POINT_BYTES].view("<f4").reshape(count, 4)
    x, y, z, intensity = (np.ascontiguousarray(points[:, i], np.float32) for i in range(4))
    return Cloud(
        stamp_ns=stamp_ns,
        receive_ns=stamp_ns,
        x_m=x,
        y_m=y,
        z_m=z,
        intensity=intensity,
        ring=rings_by_wrap(x, y, z, beams=beams),
        return_no=np.zeros(count, np.uint8),
        time_ns=None,
        stamp_at="middle",
        sweep=sweep,
    )


def read_compensated(path: Path, stamp_ns: int) -> Cloud:
    """One scan of KITTI odometry: its points were already moved to the time of the stamp."""
    cloud = read_velodyne(path, stamp_ns)
    return replace(cloud, compensated=True)


# ---------------------------------------------------------------------------------------------------------------------


def _open_raw(log: RawLog, found: list[re.Match[str]]) -> FolderLog:
    problems: list[Problem] = []
    drive, files = _one_drive(found, problems)
    times = read_timestamps(log, f"{drive}velodyne_points/timestamps.txt", problems)
    if not times:
        times = read_timestamps(log, f"{drive}oxts/timestamps.txt", problems)
        text = "velodyne_points/timestamps.txt is missing; scans take the times of oxts/timestamps.txt"
        problems.append(
            problem("kitti.timestamps_missing", "info", text if times else f"{text}, missing too: 10 Hz")
        )
    scans = _scans(log, files, times, problems, read_velodyne)
    oxts = read_oxts(log, drive, problems)
    T_velo_imu, source = read_T_velo_imu(log, problems)
    if len(oxts.stamp_ns):
        text = "heights of KITTI are above sea level, about 48 m less than above the ellipsoid; taken as they are"
        problems.append(problem("kitti.height", "info", text, GNSS))
    images = raw_images(log, drive, problems)
    cameras = raw_cameras(log, images, problems)
    return FolderLog(
        "kitti raw",
        scans,
        {IMU: imu_samples(oxts), GNSS: gnss_samples(oxts)},
        extrinsics(T_velo_imu, source),
        tuple(problems),
        scan_topic=SCANS,
        images=images,
        cameras=cameras,
    )


def _open_odometry(log: RawLog, found: list[re.Match[str]]) -> FolderLog:
    problems: list[Problem] = []
    drive, files = _one_drive(found, problems)
    times = read_seconds(log, f"{drive}times.txt")
    if not times:
        problems.append(
            problem("kitti.timestamps_missing", "warning", "times.txt is missing; 10 Hz is assumed")
        )
    scans = _scans(log, files, times, problems, read_compensated)
    images = odometry_images(log, drive, times or {number: number * SCAN_PERIOD_NS for number in files})
    cameras = odometry_cameras(log, images)
    return FolderLog(
        "kitti odometry", scans, {}, (), tuple(problems), scan_topic=SCANS, images=images, cameras=cameras
    )


def _one_drive(found: list[re.Match[str]], problems: list[Problem]) -> tuple[str, dict[int, str]]:
    """The first drive of a folder and its scan files by number."""
    drives = sorted({match["drive"] for match in found})
    if len(drives) > 1:
        text = f"the folder holds {len(drives)} drives; only {drives[0]} is read, give the others as sessions of their own"
        problems.append(problem("kitti.several_drives", "warning", text))
    files = {int(match["number"]): match.string for match in found if match["drive"] == drives[0]}
    return drives[0], dict(sorted(files.items()))


def _scans(
    log: RawLog, files: dict[int, str], times: dict[int, int], problems: list[Problem], load: LoadScan
) -> list[CloudFile]:
    """Scan files with their stamps; what is missing, without time or cut short is named."""
    if not times:
        times = {number: number * SCAN_PERIOD_NS for number in files}
    missing = sorted(set(times) - set(files))
    if missing:
        text = f"{len(missing)} of {len(times)} scans are missing: {ranges(missing)}"
        problems.append(problem("kitti.scans_missing", "warning", text, SCANS))
    timeless = sorted(set(files) - set(times))
    if timeless:
        text = f"{len(timeless)} of {len(files)} scans have no timestamp and are left out: {ranges(timeless)}"
        problems.append(problem("kitti.scans_without_time", "warning", text, SCANS))
    scans = []
    for number, name in files.items():
        if number not in times:
            continue
        path = log.path(name)
        size = path.stat().st_size
        if size < POINT_BYTES:
            problems.append(
                problem(
                    "kitti.scan_empty", "warning", f"{name} holds no point; left out", SCANS, times[number]
                )
            )
            continue
        if size % POINT_BYTES:
            text = f"{name} ends within a point: {size % POINT_BYTES} bytes left out, {size // POINT_BYTES} points kept"
            problems.append(problem("kitti.scan_cut", "warning", text, SCANS, times[number]))
        scans.append(CloudFile(times[number], times[number], partial(load, path, times[number]), str(path)))
    if not scans:
        raise InvalidInput(
            f"none of {len(files)} scans can be used",
            where=str(log.root or ""),
            next_step="; ".join(entry.text for entry in problems),
        )
    return sorted(scans, key=lambda scan: scan.stamp_ns)
