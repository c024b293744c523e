"""Gathering of a scene: what the workflow made of a drive, written as flat arrays with what every point truly is."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clean_boxes import LABELS, read_boxes
from benchmarks.clean_truth import Kinds, Known, kinds_measured, kinds_simulated, measured, simulated
from scanloom.pipeline.run import Result
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.session import TruthLog
from scanloom.schemas.trajectory import Poses, Truth
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8

LEFT_OUT = (PointClass.EGO, PointClass.OUT_OF_RANGE)
TRUE, ESTIMATED = "truth", "estimated"


def gather(log: Path | None, result: Result, folder: Path) -> None:
    """Write the arrays of a scene, a simulated one or that of the `log`; the description comes last.

    A folder with a description is whole, so that one cut off is made again.
    """
    poses: Poses = result.parts(Poses)[0]
    T = {ESTIMATED: _near_origin(poses.T_world_lidar)}
    known, kinds = _measured(log, result, T[ESTIMATED]) if log else _simulated(result)
    if log is None:
        T[TRUE] = _near_origin(_true(result.parts(Truth)[0], poses))
    _write(folder, zip(_scans(result), _labels(result), known, strict=True))
    np.save(folder / "stamp_ns.npy", poses.stamp_ns)
    for name, each in T.items():
        np.save(folder / f"T_{name}.npy", each)
    described = {
        "kinds": kinds,
        "inputs": _inputs(folder, T),
    }
    (folder / "scene.json").write_text(json.dumps(described, indent=1) + "\n")


def _true(truth: Truth, poses: Poses) -> F8:
    within = np.clip(poses.stamp_ns, truth.stamp_ns[0], truth.stamp_ns[-1])
    return interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, within)


def _near_origin(T: F8) -> F8:
    """The same poses in a frame that starts where they do, so that float32 holds millimetres."""
    moved = np.array(T, np.float64)
    moved[:, :3, 3] -= np.floor(moved[0, :3, 3])
    return moved


def _simulated(result: Result) -> tuple[Iterator[Known], Kinds]:
    (log,) = (path for _, path in result.files(TruthLog))
    return simulated(log, _scans(result)), kinds_simulated(log)


def _measured(log: Path, result: Result, T: F8) -> tuple[Iterator[Known], Kinds]:
    tracks = read_boxes(log / LABELS, T)
    return measured(tracks, _scans(result)), kinds_measured(tracks)


def _scans(result: Result) -> Iterator[DeskewedScan]:
    for chunk in result.parts(Deskewed):
        yield from chunk


def _labels(result: Result) -> Iterator[ScanLabels]:
    for chunk in result.parts(Labels):
        yield from chunk


def _write(folder: Path, rows: Iterator[tuple[DeskewedScan, ScanLabels, Known]]) -> None:
    """All points that count, one scan after the other, column by column."""
    columns: dict[str, list[NDArray[Any]]] = {
        name: [] for name in ("points", "labels", "true_class", "instance")
    }
    for scan, labels, (true_class, instance) in rows:
        counts = ~np.isin(labels.class_, LEFT_OUT)
        columns["points"].append(scan.points()[counts])
        columns["labels"].append(labels.class_[counts])
        columns["true_class"].append(true_class[counts])
        columns["instance"].append(instance[counts])
    sizes = [len(part) for part in columns["labels"]]
    np.save(folder / "starts.npy", np.concatenate(([0], np.cumsum(sizes))).astype(np.int64))
    for name, parts in columns.items():
        np.save(folder / f"{name}.npy", np.concatenate(parts))


def _inputs(folder: Path, T: dict[str, F8]) -> dict[str, str]:
    """Digest of points and poses by set of poses: what a system that knows nothing else depends on."""
    common = hashlib.sha256()
    for name in ("points", "starts"):
        common.update(np.load(folder / f"{name}.npy").data)
    digests = {}
    for name, each in T.items():
        digest = common.copy()
        digest.update(np.ascontiguousarray(each).data)
        digests[name] = digest.hexdigest()[:16]
    return digests
