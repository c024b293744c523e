"""Opens any log: one door for ingest and inspect."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import RawLog
from scanloom.stages.logs.bags import open_bags
from scanloom.stages.logs.formats import detect, stem_of
from scanloom.stages.logs.records import LogSource


def open_log(raw_log: RawLog, rate_hz: float = 10.0) -> LogSource:
    """Open the log that `locate` found.

    Parameters
    ----------
    rate_hz : scan rate of plain folders of scans, which carry no time.

    Raises
    ------
    InvalidInput : the files are no log.
    """
    if raw_log.root is None or not raw_log.names:
        raise InvalidInput(
            "The log holds no file.", next_step="give a bag, an .mcap file or a folder of scans"
        )
    found = detect(raw_log.names)
    if found.startswith("kitti"):
        from scanloom.stages.logs.kitti import open_kitti

        return open_kitti(raw_log)
    if found == "point files":
        from scanloom.stages.logs.pointfiles import open_point_files

        return open_point_files(raw_log, rate_hz)
    return open_bags(raw_log, found)


def describe_place(raw_log: RawLog) -> str:
    """The file or folder, for messages."""
    root = raw_log.root or Path()
    return str(root / raw_log.names[0]) if len(raw_log.names) == 1 else str(root)


def session_name(raw_log: RawLog) -> str:
    """A name that depends on the names inside the log only, so that a moved log gives the same bytes."""
    found = detect(raw_log.names)
    if found == "kitti raw":
        drive = next(PurePosixPath(name) for name in raw_log.names if "velodyne_points" in name)
        return drive.parts[0]
    bags = [PurePosixPath(name).name for name in raw_log.names if detect([name]) and name != "metadata.yaml"]
    return stem_of(bags[0]) if found in ("rosbag1", "rosbag2", "mcap") and bags else found
