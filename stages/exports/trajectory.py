"""Trajectories as plain text: TUM and KITTI. Poses are those of the LiDAR in the map's own frame, one line per scan."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.se3 import quaternion_from_matrix

NS_PER_S = 1_000_000_000
KITTI_NOTE = """\
Poses in the layout of the KITTI odometry benchmark, one file per session.

SESSION.txt        one line per scan: the upper three rows of T_map_lidar (4 x 4), row by row, twelve numbers, metres
SESSION_times.txt  the reference time of the same scan, seconds since 1970, one per line

The poses are those of the LiDAR (x forward, y left, z up) in the map's frame{place}.
KITTI's own files hold the left camera (x right, y down, z forward) relative to its first pose; to compare with those,
multiply with the calibration Tr (LiDAR into camera): T_cam0_cam(i) = Tr T_map_lidar(0)^-1 T_map_lidar(i) Tr^-1.
"""


def write_tum(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`SESSION.tum`, lines of `stamp tx ty tz qx qy qz qw`: seconds with nanoseconds, metres, unit quaternion."""
    return [
        _lines(folder / f"{session}.tum", _tum(poses)) for session, poses in source.trajectories().items()
    ]


def write_kitti(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`SESSION.txt`, lines of twelve numbers, `SESSION_times.txt` and a note that says which frames these are."""
    written = []
    for session, poses in source.trajectories().items():
        written.append(_lines(folder / f"{session}.txt", _kitti(poses)))
        written.append(_lines(folder / f"{session}_times.txt", (seconds(s) for s in poses.stamp_ns)))
    place = ", which is not georeferenced"
    if (origin := source.georeference) is not None:
        place = (
            f": east, north, up, its origin at latitude {origin.latitude_deg:.9f}, longitude "
            f"{origin.longitude_deg:.9f} degrees, {origin.height_m:.3f} m above the WGS84 ellipsoid"
        )
    written.append(_lines(folder / "README.txt", KITTI_NOTE.format(place=place).splitlines()))
    return written


def seconds(stamp_ns: int) -> str:
    """Decimal seconds that keep every nanosecond, which a double could not."""
    whole, part = divmod(int(stamp_ns), NS_PER_S)
    return f"{whole}.{part:09d}"


def _tum(poses: Poses) -> Iterator[str]:
    q = quaternion_from_matrix(poses.T_world_lidar[:, :3, :3])
    t = poses.T_world_lidar[:, :3, 3]
    for stamp, (x, y, z), (qw, qx, qy, qz) in zip(poses.stamp_ns, t, q, strict=True):
        yield f"{seconds(stamp)} {x:.6f} {y:.6f} {z:.6f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}"


def _kitti(poses: Poses) -> Iterator[str]:
    for row in poses.T_world_lidar[:, :3, :].reshape(-1, 12):
        yield " ".join(f"{value:.9f}" for value in row)


def _lines(path: Path, lines: Iterator[str] | list[str]) -> Path:
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(f"{line}\n" for line in lines)
    return path
