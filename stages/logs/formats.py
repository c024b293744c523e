"""Which format a set of file names is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

BAG_SUFFIXES = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd", ".bag.active")
SCAN_SUFFIXES = (".pcd", ".ply", ".bin")


def detect(names: Sequence[str]) -> str:
    """`rosbag1`, `rosbag2`, `mcap`, `kitti raw`, `kitti odometry`, `point files`, or empty."""
    paths = [PurePosixPath(name.lower()) for name in names]
    if any("velodyne_points" in path.parts for path in paths):
        return "kitti raw"
    if any(path.suffix in (".bag", ".active") for path in paths):
        return "rosbag1"
    if any(path.name == "metadata.yaml" or ".db3" in path.suffixes for path in paths):
        return "rosbag2"
    if any(".mcap" in path.suffixes for path in paths):
        return "mcap"
    if any(path.parent.name == "velodyne" and path.suffix == ".bin" for path in paths):
        return "kitti odometry"
    if any(path.suffix.lower() in SCAN_SUFFIXES for path in paths):
        return "point files"
    return ""


def stem_of(name: str) -> str:
    """A bag's name without its endings."""
    stem = name
    for suffix in (".zstd", ".active", ".bag", ".mcap", ".db3"):
        stem = stem.removesuffix(suffix)
    return stem or name
