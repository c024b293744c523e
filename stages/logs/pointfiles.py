"""Folders of scans, one file each, as a log: PCD, PLY and KITTI's `.bin`."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import Problem, RawLog
from scanloom.stages.logs.folder import FolderLog, problem
from scanloom.stages.logs.kitti import POINT_BYTES, read_velodyne
from scanloom.stages.logs.pcd import LONGEST_HEADER, read_pcd, read_pcd_header
from scanloom.stages.logs.ply import read_ply, read_ply_header
from scanloom.stages.logs.pointcloud import TIME_NAMES, cloud_from_table
from scanloom.stages.logs.records import Cloud, CloudFile

TOPIC = "scans"
SUFFIXES = (".pcd", ".ply", ".bin")


def open_point_files(raw_log: RawLog, rate_hz: float = 10.0) -> FolderLog:
    """A folder of PCD, PLY or `.bin` scans in natural order of their names.

    Stamps are the names where these are times (`1317042164.103500`, or 16 to 19 digits of us or ns); else the scans
    follow each other at `rate_hz`. Files that cannot be read are named and the others go on.

    Raises
    ------
    InvalidInput : the folder holds no such file, or none that can be read.
    """
    names = sorted((n for n in raw_log.names if Path(n).suffix.lower() in SUFFIXES), key=natural)
    if not names:
        raise InvalidInput(
            "holds no scans",
            where=str(raw_log.root or ""),
            next_step=f"give files ending in {', '.join(SUFFIXES)}",
        )
    problems: list[Problem] = []
    stamps = _stamps(names, rate_hz, problems)
    scans, timeless = [], 0
    for name, stamp_ns in zip(names, stamps):
        path = raw_log.path(name)
        try:
            timeless += not set(TIME_NAMES) & set(_look(path))
        except InvalidInput as error:
            problems.append(
                problem("points.broken", "warning", f"{name} {error.what}; left out", TOPIC, stamp_ns)
            )
            continue
        scans.append(CloudFile(stamp_ns, stamp_ns, partial(read_points, path, stamp_ns), str(path)))
    if not scans:
        raise InvalidInput(
            f"none of {len(names)} scan files can be read; {problems[-1].text}",
            where=str(raw_log.root or ""),
            next_step="check that the files are complete",
        )
    if timeless:
        text = (
            f"{timeless} of {len(scans)} scans have no point times; they are taken as not motion-compensated, "
            "one turn each. If they are compensated, set ingest.point_time to none"
        )
        problems.append(problem("points.no_times", "info", text, TOPIC))
    scans.sort(key=lambda scan: scan.stamp_ns)
    return FolderLog("point files", scans, {}, (), tuple(problems), scan_topic=TOPIC)


def read_points(path: Path, stamp_ns: int) -> Cloud:
    """One scan from a PCD, PLY or `.bin` file.

    Raises
    ------
    InvalidInput : the file is damaged, cut short, or holds no x, y, z.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return read_velodyne(path, stamp_ns, beams=None)
    try:
        data = path.read_bytes()
        table, height = read_pcd(data) if suffix == ".pcd" else (read_ply(data), 1)
        return cloud_from_table(table, stamp_ns, height=height)
    except OSError as error:
        raise InvalidInput(f"cannot be read: {error.strerror}", where=str(path)) from error
    except InvalidInput as error:
        raise InvalidInput(error.what, where=str(path), next_step=error.next_step) from error


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts `scan_9` before `scan_10`."""
    return tuple((0, int(p), "") if p.isdigit() else (1, 0, p) for p in re.split(r"(\d+)", name) if p)


def stamp_from_name(name: str) -> int | None:
    """Stamp, ns, of a file named after its time, within the years 2001 to 2100; None for a plain number."""
    stem = Path(name).stem
    found = re.fullmatch(r"(?:.*\D)?(\d{10})[._-](\d{1,9})", stem)
    if found and _plausible(seconds := int(found[1])):
        fraction = found[2]
        return seconds * 1_000_000_000 + int(fraction.ljust(9, "0"))
    found = re.fullmatch(r"(?:.*\D)?(\d{16}|\d{19})", stem)
    if found:
        value = int(found[1]) * (1000 if len(found[1]) == 16 else 1)
        return value if _plausible(value // 1_000_000_000) else None
    return None


# ---------------------------------------------------------------------------------------------------------------------


def _look(path: Path) -> tuple[str, ...]:
    """Names of the fields of a scan file, from its head.

    Raises
    ------
    InvalidInput : the head already shows that the file cannot be read.
    """
    size = path.stat().st_size
    if size == 0:
        raise InvalidInput("is empty")
    if path.suffix.lower() == ".bin":
        if size < POINT_BYTES:
            raise InvalidInput(f"holds no point ({size} bytes)")
        return ("x", "y", "z", "intensity")
    with path.open("rb") as stream:
        head = stream.read(LONGEST_HEADER)
    header = read_pcd_header(head) if path.suffix.lower() == ".pcd" else read_ply_header(head)
    if size - header.start < header.least_bytes:
        raise InvalidInput(f"is cut short: {size - header.start} of {header.least_bytes} bytes of points")
    names = tuple(name.lower() for name in header.dtype.names or ())
    if not {"x", "y", "z"} <= set(names):
        raise InvalidInput("has no x, y, z")
    return names


def _stamps(names: list[str], rate_hz: float, problems: list[Problem]) -> list[int]:
    """Stamps from the names when all of them are times, else one per period."""
    stamps = [stamp for name in names if (stamp := stamp_from_name(name)) is not None]
    if len(stamps) == len(names) and len(set(stamps)) == len(stamps):
        return stamps
    text = f"file names are not times; {rate_hz:g} scans per second are assumed"
    problems.append(problem("points.rate_assumed", "info", text, TOPIC))
    return [round(i * 1e9 / rate_hz) for i in range(len(names))]


def _plausible(seconds: int) -> bool:
    return 978_307_200 <= seconds < 4_102_444_800
