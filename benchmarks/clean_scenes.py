"""The scenes that maps are cleaned on: made through the workflow, gathered into flat arrays, kept on disk.

A scene holds every point that counts: those that denoise calls own vehicle or out of range are left out, the same for all
systems. Where there is truth of poses there are two sets of them: true ones, and those of fusion.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clean_boxes import LABELS, BoxTrack, boxed, read_boxes
from benchmarks.clean_scores import UNJUDGED
from benchmarks.sequences import NODE_OF, Drive, produced
from scanloom.pipeline.run import Result
from scanloom.schemas.product import Product
from scanloom.schemas.scans import (
    Deskewed,
    DeskewedScan,
    Labels,
    PointClass,
    ScanLabels,
    TrueLabels,
    TruePoints,
)
from scanloom.schemas.session import TruthLog
from scanloom.schemas.simulated import TrueObjects, TrueTracks
from scanloom.schemas.trajectory import Poses, Truth
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8

CLEANING = ("rays", "clean", "relabel")
"""Our stages that are run here; what they read apart from each other's products is made by the workflow."""
LEFT_OUT = (PointClass.EGO, PointClass.OUT_OF_RANGE)
REAL = Path("../shared/data/kitti_raw_0005")
TRUE, ESTIMATED = "truth", "estimated"
RESTS_M_S, DRIVES_M_S, WAITS_SCANS = 0.1, 1.0, 30


@dataclass(frozen=True)
class Place:
    """What a scene is made of."""

    drive: Drive
    poses: tuple[str, ...] = (TRUE, ESTIMATED)


_BUSY: dict[str, Any] = {"duration_s": 60.0, "busy": True}
_QUIET: dict[str, Any] = {"traffic": False, "dust_per_m": 0.0}
_SNOW: dict[str, Any] = {"start_m": 20.0, "duration_s": 20.0, "snow_per_m": 0.0035}
_DUST: dict[str, Any] = {"start_m": 620.0, "duration_s": 20.0, "dust_clouds": 0.8}


def places(seed: int = 0) -> dict[str, Place]:
    """All scenes; with another seed than 0 in another town, with other traffic and other noise."""
    seeds = {"seed": seed, "town_seed": seed, "parking_seed": seed} if seed else {}
    end = f"_{seed}" if seed else ""

    def town(name: str, title: str, more: Mapping[str, Any]) -> Place:
        return Place(Drive(name + end, title, {"beams": 32, **more, **seeds}))

    return {
        "town_32": town("town_32", "busy town, 32 beams", _BUSY),
        "town_64": town("town_64", "busy town, 64 beams", {**_BUSY, "duration_s": 40.0, "beams": 64}),
        "quiet": town("quiet", "town without traffic", {"duration_s": 40.0, **_QUIET}),
        "snow": town("snow", "snowfall in town", _SNOW),
        "dust": town("dust", "clouds of dust", _DUST),
        "kitti_0005": Place(Drive("kitti_0005", "KITTI 0005", folder=REAL), (ESTIMATED,)),
    }


@dataclass(frozen=True)
class Scene:
    """Points of all scans one after the other, and what they are; arrays are read from disk as needed."""

    name: str
    title: str
    folder: Path
    points: NDArray[np.float32]
    """(n, 3) m, in the LiDAR's frame of the point's scan."""
    labels: NDArray[np.uint8]
    """(n,) class of denoise."""
    true_class: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    """(n,) number of the object, 0 for none."""
    starts: NDArray[np.int64]
    """(m + 1,) first point of each scan."""
    stamp_ns: NDArray[np.int64]
    poses: Mapping[str, F8]
    """(m, 4, 4) poses of the LiDAR by name of the set; each starts near its origin."""
    kinds: Mapping[str, Sequence[int]]
    """Numbers of the objects of each kind; one may be of several."""
    files: Mapping[str, Sequence[str]]
    """Where the products lie, by name."""
    inputs: Mapping[str, str]
    """Digest of points and poses by set of poses."""

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.starts) - 1

    def scan(self, index: int) -> slice:
        """Rows of a scan."""
        return slice(int(self.starts[index]), int(self.starts[index + 1]))

    def placed(self, poses: str) -> NDArray[np.float32]:
        """All points (n, 3) in the map of these poses, m."""
        out = np.empty(self.points.shape, np.float32)
        for k, T in enumerate(self.poses[poses]):
            rows = self.scan(k)
            out[rows] = self.points[rows].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        return out


def of_session() -> tuple[type[Product], ...]:
    """What the stages of cleaning read of a whole session."""
    read = dict.fromkeys(product for stage in CLEANING for product in NODE_OF[stage].reads)
    between = {product for stage in CLEANING for product in NODE_OF[stage].writes}
    return tuple(p for p in read if p not in between and p not in (Deskewed, Labels))


def made() -> tuple[type[Product], ...]:
    """What the workflow makes for a scene."""
    return (Truth, Deskewed, Labels, *of_session())


def scene(place: Place, store: Path, kept: Path) -> Scene:
    """Run what is missing of the workflow and gather the points, unless that was done before.

    Raises
    ------
    ScanloomError : a stage failed.
    """
    result = produced(place.drive, made(), store)
    folder = kept / f"{place.drive.name}-{_digest(result)}"
    if not (folder / "scene.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        _gather(place, result, folder)
    return _opened(place, folder)


def _digest(result: Result) -> str:
    read = (*made(), TruthLog)
    digests = sorted(
        part.digest for _, artifact in result.artifacts for product in read for part in artifact.of(product)
    )
    return hashlib.sha256("".join(digests).encode()).hexdigest()[:16]


def _gather(place: Place, result: Result, folder: Path) -> None:
    """Write the arrays; the description comes last, so that a folder with one is whole."""
    poses: Poses = result.parts(Poses)[0]
    T = _near_origin(poses.T_world_lidar)
    np.save(folder / f"T_{ESTIMATED}.npy", T)
    np.save(folder / "stamp_ns.npy", poses.stamp_ns)
    if TRUE in place.poses:
        truth = result.parts(Truth)[0]
        within = np.clip(poses.stamp_ns, truth.stamp_ns[0], truth.stamp_ns[-1])
        true = interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, within)
        np.save(folder / f"T_{TRUE}.npy", _near_origin(true))
        kinds = _simulated(result, folder)
    else:
        kinds = _measured(place, result, folder, T)
    files = {p.NAME: [str(path) for _, path in result.files(p)] for p in (*made(), TruthLog)}
    described = {"kinds": kinds, "files": files, "inputs": _inputs(place, folder)}
    (folder / "scene.json").write_text(json.dumps(described, indent=1) + "\n")


def _inputs(place: Place, folder: Path) -> dict[str, str]:
    """Digest of points and poses by set of poses: what a system that knows nothing else depends on."""
    common = hashlib.sha256()
    for name in ("points", "starts"):
        common.update(np.load(folder / f"{name}.npy").data)
    digests = {}
    for poses in place.poses:
        digest = common.copy()
        digest.update(np.load(folder / f"T_{poses}.npy").data)
        digests[poses] = digest.hexdigest()[:16]
    return digests


def _near_origin(T: F8) -> F8:
    """The same poses in a frame that starts where they do, so that float32 holds millimetres."""
    moved = np.array(T, np.float64)
    moved[:, :3, 3] -= np.floor(moved[0, :3, 3])
    return moved


Kinds = dict[str, list[int]]


def _simulated(result: Result, folder: Path) -> Kinds:
    """Points with the simulator's own truth; what its objects are."""
    (log,) = (path for _, path in result.files(TruthLog))
    true = iter(TruePoints.open(log / "points.parquet"))
    _write(
        folder,
        ((scan, labels, _same(scan, next(true))) for scan, labels in scans_of(result)),
    )
    standing = TrueObjects.open(log / "objects.parquet")
    moving = TrueTracks.open(log / "tracks.parquet")
    kinds = _by_name(standing.what, standing.instance)
    kinds |= {f"moving_{what}": numbers for what, numbers in _by_name(moving.what, moving.instance).items()}
    return kinds | {"waiting_car": waiting_cars(moving)}


def _by_name(what: NDArray[np.object_], instance: NDArray[np.uint16]) -> Kinds:
    return {name: sorted({int(n) for n in instance[what == name]}) for name in sorted(set(what))}


def waiting_cars(moving: TrueTracks) -> list[int]:
    """Numbers of the cars that are seen to stand for three seconds and more, and to drive at another time."""
    counts = (moving.what == "car") & (moving.class_ == PointClass.DYNAMIC) & (moving.points > 0)
    rested = moving.instance[counts & (moving.speed_m_s < RESTS_M_S)]
    drove = moving.instance[counts & (moving.speed_m_s > DRIVES_M_S)]
    numbers, scans = np.unique(rested, return_counts=True)
    return [int(n) for n in numbers[scans >= WAITS_SCANS] if n in drove]


def _same(scan: DeskewedScan, true: TrueLabels) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    if len(scan) != len(true) or scan.scan_index != true.scan_index:
        raise SystemExit(f"truth of scan {true.scan_index} is not that of scan {scan.scan_index}")
    return true.class_, true.instance


def _measured(place: Place, result: Result, folder: Path, T: F8) -> Kinds:
    """Points with boxes as truth: what is in none is not judged."""
    assert place.drive.folder is not None
    tracks: list[BoxTrack] = read_boxes(place.drive.folder / LABELS, T)
    rows = ((scan, labels, boxed(scan, tracks, UNJUDGED)) for scan, labels in scans_of(result))
    _write(folder, rows)
    kinds: Kinds = {}
    for track in tracks:
        kinds.setdefault(f"{'moving' if track.moving else 'parked'}_{track.what.lower()}", []).append(
            track.number
        )
    return kinds


def scans_of(result: Result) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    """Scan by scan with the labels of denoise."""
    for chunk, labels in zip(result.parts(Deskewed), result.parts(Labels)):
        yield from zip(chunk, labels)


Row = tuple[DeskewedScan, ScanLabels, tuple[NDArray[np.uint8], NDArray[np.uint16]]]


def _write(folder: Path, rows: Iterator[Row]) -> None:
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


def _opened(place: Place, folder: Path) -> Scene:
    described = json.loads((folder / "scene.json").read_text())

    def array(name: str) -> NDArray[Any]:
        return np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r"))

    return Scene(
        name=place.drive.name,
        title=place.drive.title,
        folder=folder,
        points=array("points"),
        labels=array("labels"),
        true_class=array("true_class"),
        instance=array("instance"),
        starts=array("starts"),
        stamp_ns=array("stamp_ns"),
        poses={name: array(f"T_{name}") for name in place.poses},
        kinds=described["kinds"],
        files=described["files"],
        inputs=described["inputs"],
    )
