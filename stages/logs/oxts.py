"""Records of the OXTS GNSS/INS in KITTI raw drives, and the calibration that places it on the car.

Source: Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013, and `dataformat.txt` of
its development kit (order and frames of the fields).
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.session import Extrinsic, Matrix4, Problem, RawLog
from scanloom.stages.geometry.se3 import F8, inverse, pose
from scanloom.stages.logs.folder import problem, ranges
from scanloom.stages.logs.records import GnssSample, ImuSample

IMU, GNSS = "oxts/imu", "oxts/gnss"
OXTS_FIELDS, OXTS_LEAST = 30, 25
"""Fields of a record, and those without which it is of no use (up to the accuracy of the velocity)."""
NOMINAL_T_VELO_IMU = pose(np.eye(3), [-0.81, 0.32, -0.80])
"""Where the IMU sits on the KITTI car, to the centimetre, when a drive comes without calibration."""
HEIGHT_TO_HORIZONTAL = 2.0
"""Standard deviation of GNSS height over that of the horizontal position, which alone the receiver reports."""


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


def read_oxts(log: RawLog, drive: str, problems: list[Problem]) -> Oxts:
    """All records of `oxts/data` with their stamps; broken ones are left out and named in `problems`."""
    pattern = re.compile(re.escape(drive) + r"oxts/data/(\d+)\.txt$")
    files = sorted((int(m.group(1)), name) for name in log.names if (m := pattern.match(name)))
    times = read_timestamps(log, f"{drive}oxts/timestamps.txt", problems) if files else {}
    stamps, rows = [], []
    broken, timeless = [], []
    for number, name in files:
        row = _record(log.path(name))
        if row is None:
            broken.append(number)
        elif number not in times:
            timeless.append(number)
        else:
            stamps.append(times[number])
            rows.append(row)
    for numbers, code, what in (
        (broken, "broken", "are no OXTS record"),
        (timeless, "no_time", "have no timestamp"),
    ):
        if numbers:
            text = f"{len(numbers)} of {len(files)} files of oxts/data {what} and are left out: {ranges(numbers)}"
            problems.append(problem(f"kitti.oxts_{code}", "warning", text, IMU))
    return Oxts(np.array(stamps, np.int64), np.array(rows, float).reshape(-1, OXTS_FIELDS))


def _record(path: Path) -> F8 | None:
    """The fields of one OXTS file; those of the receiver's modes are zero where they are not given."""
    try:
        row = np.array(path.read_text().split()[:OXTS_FIELDS], float)
    except (OSError, ValueError):
        return None
    if len(row) < OXTS_LEAST or not np.isfinite(row).all():
        return None
    return np.pad(row, (0, OXTS_FIELDS - len(row)))


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
        problems.append(problem("kitti.timestamps_broken", "warning", f"{name}: {broken} lines are no time"))
    return stamps


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
        problem(
            "kitti.calibration",
            "warning",
            f"{text}; the usual place of the LiDAR on the KITTI car is assumed",
        )
    )
    return NOMINAL_T_VELO_IMU, "kitti nominal"


def imu_samples(oxts: Oxts) -> list[ImuSample]:
    """Angular rates and specific forces, in the axes of the IMU."""
    rows = zip(oxts.stamp_ns.tolist(), oxts.gyro_rad_s.tolist(), oxts.accel_m_s2.tolist())
    return [ImuSample(stamp, stamp, tuple(gyro), tuple(accel)) for stamp, gyro, accel in rows]


def gnss_samples(oxts: Oxts) -> list[GnssSample]:
    """Positions of the IMU, with the receiver's own figure of accuracy."""
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


def extrinsics(T_velo_imu: F8, source: str) -> tuple[Extrinsic, ...]:
    """The base is the IMU, whose axes are the vehicle's; the GNSS positions are those of the IMU."""
    here = _matrix4(np.eye(4))
    return (
        Extrinsic(sensor="lidar", T_base_sensor=_matrix4(inverse(T_velo_imu)), source=source),
        Extrinsic(sensor="imu", T_base_sensor=here, source=source),
        Extrinsic(sensor="gnss", T_base_sensor=here, source=source),
    )


def _matrix4(T: F8) -> Matrix4:
    """A pose as nested tuples."""
    a, b, c, d = (tuple(float(v) for v in row) for row in T)
    return a, b, c, d  # type: ignore[return-value]


def _parse_time(line: str) -> int:
    """ns since 1970 of `2011-09-26 13:02:44.103500000`."""
    whole, _, fraction = line.strip().partition(".")
    seconds = int(datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp())
    return seconds * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
