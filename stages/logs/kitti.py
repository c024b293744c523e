"""KITTI folders as logs: raw drives (scans with GNSS/INS beside them) and odometry sequences.

Source: Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013, and its development kit
(order of the OXTS fields, frames of the calibration).
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import Extrinsic, Matrix4, Problem, RawLog, Severity
from scanloom.stages.geometry.se3 import F8, inverse, pose
from scanloom.stages.geometry.sweep import CLOCKWISE, Sweep, rings_by_wrap
from scanloom.stages.logs.records import (
    Cloud,
    CloudFile,
    Damage,
    GnssSample,
    ImuSample,
    Message,
    TopicInfo,
)

SCAN_PERIOD_NS = 100_000_000
POINT_BYTES = 16
"""x, y, z in m and reflectance 0 to 1, float32 little-endian."""
HDL64_SWEEP = Sweep(CLOCKWISE, np.pi, in_firing_order=False, detected=True)
"""Clockwise from the rear, so that the middle of the sweep, which the stamp names, looks ahead. The files store each
beam by rising azimuth, which hides the order of firing; the test on drive 0005 shows that this one fits the motion."""
NOMINAL_T_VELO_IMU = pose(np.eye(3), [-0.81, 0.32, -0.80])
"""Where the IMU sits on the KITTI car, to the centimetre, when a drive comes without calibration."""
HEIGHT_TO_HORIZONTAL = 2.0
"""Standard deviation of GNSS height over that of the horizontal position, which alone the receiver reports."""

SCANS, IMU, GNSS = "velodyne_points", "oxts/imu", "oxts/gnss"
_RAW_SCAN = re.compile(r"(?P<drive>.*/|)velodyne_points/data/(?P<number>\d+)\.bin$")
_ODOMETRY_SCAN = re.compile(r"(?P<drive>.*/|)velodyne/(?P<number>\d+)\.bin$")


LoadScan = Callable[[Path, int], Cloud]


class Oxts(NamedTuple):
    """Records of the GNSS/INS, one row each: stamps and the 30 fields in the order of the development kit."""

    stamp_ns: NDArray[np.int64]
    fields: F8

    @property
    def geodetic(self) -> F8:
        """Latitude, longitude, deg, and height, m (n, 3)."""
        return self.fields[:, 0:3]

    @property
    def roll_pitch_yaw(self) -> F8:
        """Attitude (n, 3), rad: roll positive left side up, pitch positive front down, yaw 0 east, counter-clockwise."""
        return self.fields[:, 3:6]

    @property
    def accel_m_s2(self) -> F8:
        return self.fields[:, 11:14]

    @property
    def gyro_rad_s(self) -> F8:
        return self.fields[:, 17:20]

    @property
    def accuracy_m(self) -> F8:
        """The receiver's own figure for north and east (n,), m."""
        return self.fields[:, 23]

    @property
    def speed_m_s(self) -> F8:
        """Forward, left, up (n, 3), parallel to the surface of the Earth."""
        return self.fields[:, 8:11]


class FolderLog:
    """A `LogSource` over files: scans are read one at a time, the rest is small and in memory."""

    def __init__(
        self,
        format_name: str,
        scans: list[CloudFile],
        others: dict[str, list[ImuSample] | list[GnssSample]],
        extrinsics: tuple[Extrinsic, ...] = (),
        problems: tuple[Problem, ...] = (),
        scan_topic: str = SCANS,
    ) -> None:
        self.format = format_name
        self.extrinsics = extrinsics
        self.problems = problems
        self.damage = Damage()
        self._scan_topic = scan_topic
        self._scans = scans
        self._others = others
        stamps = {scan_topic: [scan.stamp_ns for scan in scans]}
        stamps |= {
            topic: [sample.stamp_ns for sample in samples] for topic, samples in others.items() if samples
        }
        self.topics = tuple(_topic(name, scan_topic, values) for name, values in stamps.items() if values)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of the given topics in order of time."""
        streams: list[list[Message]] = []
        if self._scan_topic in topics:
            streams.append([Message(self._scan_topic, scan) for scan in self._scans])
        for topic, samples in self._others.items():
            if topic in topics:
                streams.append([Message(topic, sample) for sample in samples])
        yield from heapq.merge(*streams, key=lambda message: message.body.stamp_ns)


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


def read_oxts(log: RawLog, drive: str, problems: list[Problem]) -> Oxts:
    """All records of `oxts/data` with their stamps; broken ones are left out and named in `problems`."""
    pattern = re.compile(re.escape(drive) + r"oxts/data/(\d+)\.txt$")
    files = sorted((int(m.group(1)), name) for name in log.names if (m := pattern.match(name)))
    times = read_timestamps(log, f"{drive}oxts/timestamps.txt", problems) if files else {}
    stamps, rows = [], []
    for number, name in files:
        try:
            row = np.array(log.path(name).read_text().split(), float)
        except (OSError, ValueError):
            row = np.empty(0)
        if len(row) < 25 or not np.isfinite(row[:25]).all():
            problems.append(
                _problem("kitti.oxts_broken", "warning", f"{name} is not an OXTS record; left out")
            )
        elif number not in times:
            problems.append(_problem("kitti.oxts_no_time", "warning", f"{name} has no timestamp; left out"))
        else:
            stamps.append(times[number])
            rows.append(np.resize(np.append(row, np.zeros(30)), 30))
    return Oxts(np.array(stamps, np.int64), np.array(rows, float).reshape(-1, 30))


def read_timestamps(log: RawLog, name: str, problems: list[Problem]) -> dict[int, int]:
    """Stamps, ns, by line number from 0 of a KITTI `timestamps.txt` (taken as UTC); empty when it is absent."""
    if name not in log.names:
        return {}
    stamps: dict[int, int] = {}
    broken = 0
    for number, line in enumerate(log.path(name).read_text(errors="replace").splitlines()):
        if not line.strip():
            continue
        try:
            stamps[number] = _parse_time(line)
        except ValueError:
            broken += 1
    if broken:
        problems.append(_problem("kitti.timestamps_broken", "warning", f"{name}: {broken} lines are no time"))
    return stamps


def read_calibration(path: Path) -> dict[str, F8]:
    """Numbers of a KITTI calibration file by key (`R`, `T`, `Tr`, `P0`, ...)."""
    found = {}
    for line in path.read_text(errors="replace").splitlines():
        key, _, values = line.partition(":")
        try:
            found[key.strip()] = np.array(values.split(), float)
        except ValueError:
            continue
    return found


def read_T_velo_imu(log: RawLog, problems: list[Problem]) -> tuple[F8, str]:
    """Pose of the IMU in the LiDAR's frame from `calib_imu_to_velo.txt`, and where it comes from."""
    name = next((name for name in log.names if name.endswith("calib_imu_to_velo.txt")), "")
    if name:
        numbers = read_calibration(log.path(name))
        if len(numbers.get("R", ())) == 9 and len(numbers.get("T", ())) == 3:
            return pose(numbers["R"].reshape(3, 3), numbers["T"]), "kitti calibration"
    text = f"{name} is no calibration" if name else "calib_imu_to_velo.txt is missing"
    problems.append(
        _problem(
            "kitti.calibration",
            "warning",
            f"{text}; the usual place of the LiDAR on the KITTI car is assumed",
        )
    )
    return NOMINAL_T_VELO_IMU, "kitti nominal"


# ---------------------------------------------------------------------------------------------------------------------


def _open_raw(log: RawLog, found: list[re.Match[str]]) -> FolderLog:
    problems: list[Problem] = []
    drive, files = _one_drive(found, problems)
    times = read_timestamps(log, f"{drive}velodyne_points/timestamps.txt", problems)
    if not times:
        times = read_timestamps(log, f"{drive}oxts/timestamps.txt", problems)
        text = "velodyne_points/timestamps.txt is missing; scans take the times of oxts/timestamps.txt"
        problems.append(
            _problem("kitti.timestamps_missing", "info", text if times else f"{text}, missing too: 10 Hz")
        )
    scans = _scans(log, files, times, problems, read_velodyne)
    oxts = read_oxts(log, drive, problems)
    T_velo_imu, source = read_T_velo_imu(log, problems)
    if len(oxts.stamp_ns):
        text = "heights of KITTI are above sea level, about 48 m less than above the ellipsoid; taken as they are"
        problems.append(_problem("kitti.height", "info", text, GNSS))
    return FolderLog(
        "kitti raw",
        scans,
        {IMU: _imu(oxts), GNSS: _gnss(oxts)},
        _extrinsics(T_velo_imu, source),
        tuple(problems),
    )


def _open_odometry(log: RawLog, found: list[re.Match[str]]) -> FolderLog:
    problems: list[Problem] = []
    drive, files = _one_drive(found, problems)
    times = read_seconds(log, f"{drive}times.txt")
    if not times:
        problems.append(
            _problem("kitti.timestamps_missing", "warning", "times.txt is missing; 10 Hz is assumed")
        )
    scans = _scans(log, files, times, problems, read_compensated)
    return FolderLog("kitti odometry", scans, {}, (), tuple(problems))


def read_seconds(log: RawLog, name: str) -> dict[int, int]:
    """Stamps, ns, by line number of a file with one time in seconds per line; empty when it is absent."""
    if name not in log.names:
        return {}
    stamps = {}
    for number, line in enumerate(log.path(name).read_text(errors="replace").splitlines()):
        try:
            stamps[number] = round(float(line) * 1e9)
        except (ValueError, OverflowError):
            continue
    return stamps


def _one_drive(found: list[re.Match[str]], problems: list[Problem]) -> tuple[str, dict[int, str]]:
    """The first drive of a folder and its scan files by number."""
    drives = sorted({match["drive"] for match in found})
    if len(drives) > 1:
        text = f"the folder holds {len(drives)} drives; only {drives[0]} is read, give the others as sessions of their own"
        problems.append(_problem("kitti.several_drives", "warning", text))
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
        text = f"{len(missing)} of {len(times)} scans are missing: {_ranges(missing)}"
        problems.append(_problem("kitti.scans_missing", "warning", text, SCANS))
    timeless = sorted(set(files) - set(times))
    if timeless:
        text = (
            f"{len(timeless)} of {len(files)} scans have no timestamp and are left out: {_ranges(timeless)}"
        )
        problems.append(_problem("kitti.scans_without_time", "warning", text, SCANS))
    scans = []
    for number, name in files.items():
        if number not in times:
            continue
        path = log.path(name)
        size = path.stat().st_size
        if size < POINT_BYTES:
            problems.append(
                _problem(
                    "kitti.scan_empty", "warning", f"{name} holds no point; left out", SCANS, times[number]
                )
            )
            continue
        if size % POINT_BYTES:
            text = f"{name} ends within a point: {size % POINT_BYTES} bytes left out, {size // POINT_BYTES} points kept"
            problems.append(_problem("kitti.scan_cut", "warning", text, SCANS, times[number]))
        scans.append(CloudFile(times[number], times[number], partial(load, path, times[number]), str(path)))
    if not scans:
        raise InvalidInput(
            f"none of {len(files)} scans can be used",
            where=str(log.root or ""),
            next_step="; ".join(problem.text for problem in problems),
        )
    return sorted(scans, key=lambda scan: scan.stamp_ns)


def _imu(oxts: Oxts) -> list[ImuSample]:
    rows = zip(oxts.stamp_ns.tolist(), oxts.gyro_rad_s.tolist(), oxts.accel_m_s2.tolist())
    return [ImuSample(stamp, stamp, tuple(gyro), tuple(accel)) for stamp, gyro, accel in rows]


def _gnss(oxts: Oxts) -> list[GnssSample]:
    samples = []
    for stamp, row in zip(oxts.stamp_ns.tolist(), oxts.fields.tolist()):
        horizontal = row[23] ** 2
        covariance = (
            horizontal,
            0.0,
            0.0,
            0.0,
            horizontal,
            0.0,
            0.0,
            0.0,
            horizontal * HEIGHT_TO_HORIZONTAL**2,
        )
        status = _status(int(row[25]), int(row[27]))
        samples.append(
            GnssSample(
                stamp,
                stamp,
                row[0],
                row[1],
                row[2],
                covariance,
                status,
                int(row[26]),
                covariance_known=horizontal > 0,
            )
        )
    return samples


def _status(navigation: int, mode: int) -> int:
    """NavSatStatus from OXTS `navstat` (4 locked) and `posmode` (3 single, 4 differential, 5 and 6 RTK, 7 WAAS).

    Records that do not tell (zeros throughout, or mode -1) count as a plain fix.
    """
    if mode < 0 or (navigation == 0 and mode == 0):
        return 0
    if navigation != 4 or mode < 3:
        return -1
    return {4: 2, 5: 2, 6: 2, 7: 1}.get(mode, 0)


def _extrinsics(T_velo_imu: F8, source: str) -> tuple[Extrinsic, ...]:
    """The base is the IMU, whose axes are the vehicle's; the GNSS positions are those of the IMU."""
    here = matrix4(np.eye(4))
    return (
        Extrinsic(sensor="lidar", T_base_sensor=matrix4(inverse(T_velo_imu)), source=source),
        Extrinsic(sensor="imu", T_base_sensor=here, source=source),
        Extrinsic(sensor="gnss", T_base_sensor=here, source=source),
    )


def matrix4(T: F8) -> Matrix4:
    """A pose as nested tuples."""
    a, b, c, d = (tuple(float(v) for v in row) for row in T)
    return a, b, c, d  # type: ignore[return-value]


def _topic(name: str, scan_topic: str, stamps: list[int]) -> TopicInfo:
    ordered = sorted(stamps)
    period = int(np.median(np.diff(ordered))) if len(ordered) > 1 else 0
    if name == scan_topic:
        return TopicInfo(
            name, "sensor_msgs/msg/PointCloud2", "cloud", len(stamps), ordered[0], ordered[-1], period
        )
    if name.endswith("imu"):
        return TopicInfo(name, "sensor_msgs/msg/Imu", "imu", len(stamps), ordered[0], ordered[-1], period)
    return TopicInfo(name, "sensor_msgs/msg/NavSatFix", "gnss", len(stamps), ordered[0], ordered[-1], period)


def _parse_time(line: str) -> int:
    """ns since 1970 of `2011-09-26 13:02:44.103500000`."""
    whole, _, fraction = line.strip().partition(".")
    seconds = int(datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp())
    return seconds * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))


def _problem(code: str, severity: Severity, text: str, topic: str = "", stamp_ns: int = 0) -> Problem:
    return Problem(code=code, severity=severity, text=text, topic=topic, stamp_ns=stamp_ns)


def _ranges(numbers: list[int], most: int = 5) -> str:
    """`3, 7 to 9, 12`, at most a few."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    words = [str(a) if a == b else f"{a} to {b}" for a, b in runs[:most]]
    return ", ".join(words) + (", ..." if len(runs) > most else "")
