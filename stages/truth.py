"""Truth: the true trajectory of the LiDAR, from whatever a data set offers, for evaluation only."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.frames import Georeference
from scanloom.schemas.session import IDENTITY, Matrix4, Problem, RawLog, TruthLog
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.geodesy import geodetic_to_world, georeference
from scanloom.stages.geometry.se3 import F8, inverse, matrix_from_quaternion, pose
from scanloom.stages.logs.oxts import Oxts, read_calibration, read_oxts, read_seconds, read_T_velo_imu

VERSION = 1

# Axes of a camera (x right, y down, z forward) seen from a LiDAR (x forward, y left, z up).
T_CAMERA_LIDAR = pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))

KITTI_WIDTH, TUM_WIDTH = 12, 8
"""Numbers in a line of KITTI odometry's poses and of a TUM file."""
_OXTS = re.compile(r"(?P<drive>.*/|)oxts/data/\d+\.txt$")


class Settings(BaseModel):
    """What the true poses are of, for files that do not say."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    poses_of: Literal["lidar", "camera", "sensor"] = Field(
        "lidar",
        description="what a TUM file gives the poses of: the LiDAR; a camera (x right, y down, z forward) at the place "
        "that calib.txt beside it tells, else at the LiDAR; another sensor, placed by `T_sensor_lidar`",
    )
    T_sensor_lidar: Matrix4 = Field(
        IDENTITY,
        description="pose of the LiDAR in the frame of that sensor, row by row, m; used with poses_of sensor",
    )
    time_offset_s: float = Field(
        0.0, ge=-1e10, le=1e10, description="added to the stamps of truth to get the LiDAR's clock, s"
    )


def truth(settings: Settings, truth_log: TruthLog) -> Truth:
    """The true trajectory of the LiDAR.

    Reads, in this order of preference: the simulator's `trajectory.parquet`; a text file with 12 numbers a line (KITTI
    odometry's poses, with `times.txt`) or 8 (TUM: `stamp tx ty tz qx qy qz qw`); OXTS records of KITTI raw.
    No files give no rows.

    Raises
    ------
    InvalidInput : there are files, but none of these; or one of them cannot be read.
    """
    if not truth_log.names:
        return Truth.empty(source="none")
    found = _simulated(truth_log)
    if found is None:
        found = _text(settings, truth_log)
    if found is None:
        found = _oxts(truth_log)
    if found is None:
        raise InvalidInput(
            f"no trajectory among {', '.join(truth_log.names[:5])}",
            where=str(truth_log.root or ""),
            next_step="give a TUM file, KITTI poses with times.txt, KITTI oxts, or the simulator's truth folder",
        )
    return _in_order(found, round(settings.time_offset_s * 1e9))


def oxts_poses(oxts: Oxts) -> F8:
    """Poses of the IMU (n, 4, 4) in local east, north, up at the first record.

    Attitude by the development kit: R = Rz(yaw) Ry(pitch) Rx(roll), yaw 0 towards east, counter-clockwise.
    """
    lat, lon, height = oxts.geodetic.T
    position = geodetic_to_world(oxts_origin(oxts), lat, lon, height)
    return pose(_from_roll_pitch_yaw(oxts.roll_pitch_yaw), position)


def oxts_origin(oxts: Oxts) -> Georeference:
    """Where the frame of `oxts_poses` stands: at the first record."""
    return georeference(*oxts.geodetic[0].tolist())


# ---------------------------------------------------------------------------------------------------------------------


def _simulated(log: TruthLog) -> Truth | None:
    name = _named(log, "trajectory.parquet")
    return Truth.open(log.path(name)) if name else None


def _text(settings: Settings, log: TruthLog) -> Truth | None:
    """The first text file whose lines are poses."""
    for name in log.names:
        if not name.endswith((".txt", ".tum", ".csv")) or "oxts/" in name:
            continue
        width = _width(log.path(name))
        if width == KITTI_WIDTH:
            return _kitti_poses(log, name)
        if width == TUM_WIDTH or name.endswith(".tum"):
            return _tum(settings, log, name)
    return None


def _kitti_poses(log: TruthLog, name: str) -> Truth:
    """12 numbers a line, the left camera in its first frame; `Tr` of calib.txt takes LiDAR to camera."""
    rows = _numbers(log.path(name), KITTI_WIDTH)
    times = _named(log, "times.txt")
    stamps = read_seconds(_as_raw(log), times) if times else {}
    if not set(range(len(rows))) <= set(stamps):
        raise InvalidInput(
            f"times.txt has {len(stamps)} times for {len(rows)} poses",
            where=str(log.root or ""),
            next_step="put the sequence's times.txt beside its poses",
        )
    matrices = rows.reshape(-1, 3, 4)
    T_camera_lidar, how = _T_camera_lidar(log)
    return Truth(
        stamp_ns=np.array([stamps[i] for i in range(len(rows))], np.int64),
        T_truth_lidar=_seen_from_lidar(pose(matrices[:, :, :3], matrices[:, :, 3]), T_camera_lidar),
        source=f"KITTI odometry poses ({how}); from RTK GNSS/INS, good to about 0.1 m where reception was good",
    )


def _tum(settings: Settings, log: TruthLog, name: str) -> Truth:
    path = log.path(name)
    rows = _numbers(path, TUM_WIDTH)
    if not (np.linalg.norm(rows[:, 4:], axis=1) > 0.1).all():
        raise InvalidInput("holds a quaternion that is no rotation", where=str(path))
    T = pose(matrix_from_quaternion(rows[:, [7, 4, 5, 6]]), rows[:, 1:4])
    source = f"TUM file {path.name}; its accuracy is not known here"
    if settings.poses_of == "camera":
        T_camera_lidar, how = _T_camera_lidar(log)
        T, source = _seen_from_lidar(T, T_camera_lidar), f"{source}; poses of a camera, {how}"
    elif settings.poses_of == "sensor":
        T = T @ np.array(settings.T_sensor_lidar)
        source = f"{source}; poses of another sensor, moved to the LiDAR"
    return Truth(stamp_ns=_tum_stamps(path), T_truth_lidar=T, source=source)


def _oxts(log: TruthLog) -> Truth | None:
    drive = next((match["drive"] for name in log.names if (match := _OXTS.match(name))), None)
    if drive is None:
        return None
    problems: list[Problem] = []
    oxts = read_oxts(_as_raw(log), drive, problems)
    if len(oxts.stamp_ns) == 0:
        text = "; ".join(problem.text for problem in problems[:3])
        raise InvalidInput(f"no OXTS record can be read: {text}", where=str(log.root or ""))
    T_velo_imu, how = read_T_velo_imu(_as_raw(log), problems)
    T = oxts_poses(oxts) @ inverse(T_velo_imu)
    source = (
        f"OXTS GNSS/INS of KITTI raw ({how}); its own accuracy figure is {oxts.accuracy_m.min():.2f} to "
        f"{oxts.accuracy_m.max():.2f} m; not independent of the GNSS positions and IMU that the pipeline reads"
    )
    return Truth(oxts.stamp_ns, T, source, oxts_origin(oxts).model_dump())


def _in_order(found: Truth, offset_ns: int) -> Truth:
    """Stamps increasing, each once, on the LiDAR's clock."""
    _, rows = np.unique(found.stamp_ns, return_index=True)
    ordered = found if len(rows) == len(found) and (np.diff(rows) > 0).all() else found.take(rows)
    if offset_ns == 0:
        return ordered
    return replace(
        ordered,
        stamp_ns=ordered.stamp_ns + np.int64(offset_ns),
        source=f"{ordered.source}; stamps moved by {offset_ns * 1e-9:+.3f} s",
    )


def _T_camera_lidar(log: TruthLog) -> tuple[F8, str]:
    name = _named(log, "calib.txt")
    if name:
        numbers = read_calibration(log.path(name))
        Tr = numbers.get("Tr", numbers.get("Tr_velo_to_cam", np.empty(0)))
        if len(Tr) == 12:
            return pose(Tr.reshape(3, 4)[:, :3], Tr.reshape(3, 4)[:, 3]), "moved to the LiDAR by calib.txt"
    return T_CAMERA_LIDAR, "axes turned to the LiDAR's, distance between camera and LiDAR not known"


def _seen_from_lidar(T_world_camera: F8, T_camera_lidar: F8) -> F8:
    """Poses of the LiDAR in the frame of the first LiDAR when the given ones start at the first camera."""
    return inverse(T_camera_lidar) @ T_world_camera @ T_camera_lidar


def _lines(path: Path) -> list[list[str]]:
    """Words of every line that is neither blank nor a comment."""
    lines = path.read_text(errors="replace").replace(",", " ").splitlines()
    return [line.split() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def _width(path: Path) -> int:
    """How many numbers the first line of data has; 0 when it holds anything else."""
    with path.open(errors="replace") as lines:
        first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    try:
        return len([float(word) for word in first.replace(",", " ").split()])
    except ValueError:
        return 0


def _numbers(path: Path, width: int) -> F8:
    try:
        rows = np.array(_lines(path), float)
    except ValueError as error:
        raise InvalidInput(f"holds a line that is no pose: {error}", where=str(path)) from error
    if rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all():
        raise InvalidInput(
            f"has lines without {width} finite numbers",
            where=str(path),
            next_step="give lines of `stamp tx ty tz qx qy qz qw`, stamp in seconds, or KITTI's poses",
        )
    return rows


def _tum_stamps(path: Path) -> NDArray[np.int64]:
    """Seconds as text to ns: a double of seconds since 1970 is only good to 240 ns."""
    stamps = []
    for words in _lines(path):
        whole, _, fraction = words[0].partition(".")
        exact = whole.lstrip("+-").isdigit() and (fraction.isdigit() or not fraction)
        if exact:
            size = int(whole.lstrip("+-")) * 1_000_000_000 + int(fraction[:9].ljust(9, "0") or 0)
            stamps.append(-size if whole.startswith("-") else size)
        else:
            stamps.append(round(float(words[0]) * 1e9))
    return np.array(stamps, np.int64)


def _named(log: TruthLog, file_name: str) -> str:
    return next((name for name in log.names if Path(name).name == file_name), "")


def _as_raw(log: TruthLog) -> RawLog:
    return RawLog(root=log.root, names=log.names)


def _from_roll_pitch_yaw(angles: F8) -> F8:
    """Rz(yaw) Ry(pitch) Rx(roll) (n, 3, 3) of roll, pitch, yaw (n, 3), rad."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
