"""What a user gets: the folder of a map, filled from the store."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.pipeline.run import Result
from scanloom.schemas.changes import ChangeFiles, Changes
from scanloom.schemas.errors import StoreError, UsageError
from scanloom.schemas.evaluation import Metrics, PictureFiles
from scanloom.schemas.loops import Loops
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Files
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import MapFiles, Overview, RemovedTile, Tile, TileFiles, TileIndex
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry.se3 import quaternion_from_matrix

MARKER = ".scanloom"
MAP_FILE = "map.json"
MAP_FORMAT = "scanloom map 1"
Metric = dict[str, Any]


@dataclass(frozen=True)
class Label:
    """What a map is called, and what it was made of."""

    name: str
    version: int = 1
    parent: dict[str, Any] | None = None
    """Name, version and checksum of the map it extends."""
    logs: Mapping[str, str] = field(default_factory=dict)
    """Digest of each session's log."""


def claim(out: Path) -> None:
    """Make the folder of a map, or refuse one that holds something else.

    Raises
    ------
    UsageError : the folder is not empty and was not made by a map.
    """
    if out.is_file():
        raise UsageError("is a file, not a folder", where=str(out), next_step="give another --out")
    if out.is_dir() and any(out.iterdir()) and not (out / MARKER).exists():
        raise UsageError(
            "is not empty and does not hold a map",
            where=str(out),
            next_step="give --out a new folder; nothing there was touched",
        )
    out.mkdir(parents=True, exist_ok=True)
    (out / MARKER).touch()


@dataclass(frozen=True)
class Item:
    """One file to deliver: an existing file or bytes."""

    name: str
    source: Path | bytes


def deliver(result: Result, out: Path, label: Label) -> dict[str, Any]:
    """Fill the folder with everything that does not vary between runs; returns the content of `map.json`."""
    items = list(_items(result))
    previous = read_map(out)
    old = previous.get("files", {})
    files: dict[str, dict[str, Any]] = {}
    for item in items:
        digest, size = _digest(item.source)
        files[item.name] = {"sha256": digest, "bytes": size}
        if old.get(item.name) != files[item.name] or not _same_size(out / item.name, size):
            place(item.source, out / item.name)
    for stale in set(old) - set(files):
        (out / stale).unlink(missing_ok=True)
    content = {**_description(result, label), "files": files}
    place((json.dumps(content, indent=1, sort_keys=True) + "\n").encode(), out / MAP_FILE)
    return content


def read_map(out: Path) -> dict[str, Any]:
    """Content of `map.json`, empty when there is none or it was cut off."""
    try:
        content: dict[str, Any] = json.loads((out / MAP_FILE).read_text())
    except (OSError, ValueError):
        return {}
    return content


def write_text(path: Path, text: str) -> None:
    """Whole or not at all."""
    place(text.encode(), path)


def metric_rows(metrics: Metrics) -> list[Metric]:
    """Rows as they stand in `metrics.json`; the session is named when there is more than one.

    `truth` says whether truth was needed, `samples` from how many samples the value comes, where it is no plain count.
    """
    several = len({s for s in metrics.session if s}) > 1
    rows = []
    for i in range(len(metrics)):
        row = {key: getattr(metrics, key)[i] for key in ("name", "value", "unit", "scope", "method")}
        row["value"] = float(row["value"])
        row["truth"] = bool(metrics.truth[i])
        if metrics.samples[i] >= 0:
            row["samples"] = int(metrics.samples[i])
        if several and metrics.session[i]:
            row["session"] = metrics.session[i]
        rows.append(row)
    return rows


def change_rows(result: Result) -> list[Metric]:
    """What an extension saw change; nothing for a map that extends none."""
    found = [table for table in result.parts(Changes) if table.sessions]
    if not found:
        return []
    points, objects = sum(map(len, found)), sum(len(np.unique(table.object_)) for table in found)
    method = "standing points of the old map, one per voxel, that new sessions saw through and hardly met"

    def row(name: str, value: int, method: str) -> Metric:
        return {"name": name, "value": float(value), "unit": "", "scope": "map", "method": method}

    return [
        row("changes.points", points, method),
        row("changes.objects", objects, "such points gathered by distance"),
    ]


def _items(result: Result) -> Iterable[Item]:
    yield from _tile_items(result)
    yield from _session_items(result)
    for product, names in WHOLE.items():
        for _, folder in result.files(product):
            yield from (Item(name, folder / name) for name in names if (folder / name).exists())
    for _, path in result.files(Loops):
        yield Item("loops.parquet", path)
    for _, path in result.files(Changes):
        if Changes.open(path).sessions:
            yield Item("changes.parquet", path)


WHOLE: dict[type[Files], tuple[str, ...]] = {
    MapFiles: ("map.ply", "removed.ply"),
    ChangeFiles: ("changes.ply",),
    PictureFiles: ("preview.png",),
}
"""Files of the map as a whole."""


def _tile_items(result: Result) -> Iterable[Item]:
    for coordinate, path in result.files(Tile):
        yield Item(f"tiles/{dict(coordinate)['tile']}.parquet", path)
    for coordinate, path in result.files(TileFiles):
        yield Item(f"tiles/{dict(coordinate)['tile']}.ply", path / "tile.ply")
    for coordinate, path in result.files(RemovedTile):
        yield Item(f"removed/{dict(coordinate)['tile']}.parquet", path)
    for _, path in result.files(TileIndex):
        yield Item("tiles/index.parquet", path)
    for _, path in result.files(Overview):
        yield Item("tiles/overview.parquet", path)


def _session_items(result: Result) -> Iterable[Item]:
    poses = result.files(Poses)
    for coordinate, path in poses:
        name = trajectory_file(dict(coordinate)["session"], len(poses))
        yield Item(name, path)
        yield Item(f"{name.removesuffix('.parquet')}.tum", trajectory_tum(Poses.open(path)))
    tracks = result.files(ObjectTracks)
    for coordinate, path in tracks:
        yield Item(objects_file(dict(coordinate)["session"], len(tracks)), path)


def objects_file(session: str, sessions: int) -> str:
    """Where a map of so many sessions keeps the boxes of what moved in this one."""
    return "objects.parquet" if sessions == 1 else f"objects/{session}.parquet"


def trajectory_file(session: str, sessions: int) -> str:
    """Where a map of so many sessions keeps the poses of this one."""
    return "trajectory.parquet" if sessions == 1 else f"trajectory/{session}.parquet"


def trajectory_tum(poses: Poses) -> bytes:
    """One line per scan: `stamp tx ty tz qx qy qz qw`; the stamp keeps its nanoseconds."""
    q = quaternion_from_matrix(poses.T_world_lidar[:, :3, :3])
    t = poses.T_world_lidar[:, :3, 3]
    lines = []
    for stamp, (x, y, z), (qw, qx, qy, qz) in zip(poses.stamp_ns, t, q, strict=True):
        seconds, nanoseconds = divmod(int(stamp), 1_000_000_000)
        lines.append(
            f"{seconds}.{nanoseconds:09d} {x:.6f} {y:.6f} {z:.6f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}\n"
        )
    return "".join(lines).encode()


def _description(result: Result, label: Label) -> dict[str, Any]:
    index = result.parts(TileIndex)[0]
    mapped = {dict(coordinate)["session"] for coordinate, _ in result.files(Poses)}
    keys = {dict(coordinate)["session"]: path.parent.name for coordinate, path in result.files(Session)}
    sessions = [
        {
            "name": name,
            "log": label.logs.get(name, ""),
            "scans": s.scan_count,
            "start_ns": s.start_ns,
            "end_ns": s.end_ns,
            "complete": s.complete,
            "problems": [p.text for p in s.problems if p.severity != "info"],
        }
        for name, s in _by_name(result)
        if name in mapped
    ]
    low, high = index.bounds_m.tolist()
    return {
        "format": MAP_FORMAT,
        "name": label.name,
        "version": label.version,
        "parent": label.parent,
        "frame": index.frame,
        "crs": index.georeference,
        "epsg": index.georeference["epsg"] if index.georeference else None,
        "origin": index.georeference,
        "bounds_m": {"min": low, "max": high},
        "points": int(index.points.sum()),
        "tile_size_m": index.tile_size_m,
        "voxel_size_m": index.voxel_size_m,
        "sessions": sessions,
        "session_artifacts": keys,
    }


def _by_name(result: Result) -> list[tuple[str, Session]]:
    """Sessions by their names in this run, which keep two logs of the same name apart."""
    return [(where["session"], session) for where, session in result.parts(Session).items()]


def _digest(source: Path | bytes) -> tuple[str, int]:
    if isinstance(source, bytes):
        return hashlib.sha256(source).hexdigest(), len(source)
    with source.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest(), source.stat().st_size


def _same_size(path: Path, size: int) -> bool:
    try:
        return path.stat().st_size == size
    except OSError:
        return False


def place(source: Path | bytes, target: Path) -> None:
    """Write beside the target, then rename: a reader never sees half a file."""
    part = target.with_name(f".{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(source, bytes):
            part.write_bytes(source)
        else:
            shutil.copyfile(source, part)
        os.replace(part, target)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise StoreError(
            f"cannot be written: {error.strerror}",
            where=str(target),
            next_step="free space or fix the permissions, then run the same command again",
        ) from error
