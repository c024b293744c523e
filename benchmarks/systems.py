"""The systems that are compared, each run in a process of its own: `python -m benchmarks.systems ORDER.json`.

A process runs one system once over one recording and writes `OUT.npz`: poses with the stamps they hold for, time per frame,
peak memory, threads. All systems get the same frames. Reading files is never part of the time.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.sequences import Recording
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels, PointClass, Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_log

MAX_RANGE_M = 100.0
NEAR_M = 2.0
INSERT_M = 0.5
LOST_SHARE = 0.2
"""VGICP with fewer inliers has lost its map; what it says from there on is not looked at."""
WARM_UP = 8
"""Scans of a first run whose time does not count: compiled code is loaded, caches fill."""


@dataclass(frozen=True)
class Outcome:
    """What a system says of a recording."""

    stamp_ns: NDArray[np.int64]
    """(n,) times the poses hold for; not the same instant of the sweep for every system."""
    T: F8
    """(n, 4, 4) poses of the LiDAR in the system's own frame."""
    ms: F8
    """(n,) time per frame."""
    peak_mb: float
    threads: int
    extra: dict[str, Any] = field(default_factory=dict)
    """More of our own system: arrays (n, ...) and figures."""

    def write(self, path: Path) -> None:
        known: dict[str, Any] = {"stamp_ns": self.stamp_ns, "T": self.T, "ms": self.ms}
        np.savez(path, **known, peak_mb=self.peak_mb, threads=self.threads, **self.extra)

    @classmethod
    def read(cls, path: Path) -> Outcome:
        with np.load(path) as file:
            body = {name: file[name] for name in file.files}
        known = {name: body.pop(name) for name in ("stamp_ns", "T", "ms")}
        return cls(**known, peak_mb=float(body.pop("peak_mb")), threads=int(body.pop("threads")), extra=body)


def run(program: str, recording: Recording, options: dict[str, Any]) -> Outcome:
    """One program, once over one recording, in this process."""
    runners: dict[str, Callable[..., Outcome]] = {
        "scanloom": _scanloom, "kiss_icp": _kiss_icp, "small_gicp": _small_gicp,
    }  # fmt: skip
    return runners[program](recording, **options)


def program(system: str) -> str:
    """What runs for a system: VGICP on our scans is small_gicp, too."""
    return "small_gicp" if system == "vgicp_on_our_scans" else system


def version(system: str) -> str:
    """Version of what runs for a system; empty when it is not installed."""
    try:
        return metadata.version({"kiss_icp": "kiss-icp"}.get(system, program(system)))
    except metadata.PackageNotFoundError:
        return ""


# Ours ----------------------------------------------------------------------------------------------------------------


def _scanloom(recording: Recording, timed: bool = True, settings: dict[str, Any] | None = None) -> Outcome:
    """Deskew and odometry. Times are taken with the scans in memory and everything on one core; memory without."""
    from scanloom.stages.odometry import Settings, odometry

    chosen = Settings(**(settings or {}))
    deskewed, labels = recording.parts(Deskewed), recording.parts(Labels)
    if not timed:
        started = time.perf_counter()
        track = odometry(chosen, *recording.arguments("odometry", {Deskewed: deskewed, Labels: labels}))
        extra = {"whole_ms": 1e3 * (time.perf_counter() - started), **_columns(track)}
        cores = len(os.sched_getaffinity(0))
        return Outcome(track.stamp_ns, track.T_odom_lidar, np.zeros(len(track)), _peak_mb(), cores, extra)
    on_one_core()
    scans, classes = [*_flat(deskewed)], [*_flat(labels)]
    first = {Deskewed: _as_parts(scans[:WARM_UP]), Labels: _as_parts(classes[:WARM_UP])}
    odometry(chosen, *recording.arguments("odometry", first))
    clock = Clock()
    given = recording.arguments("odometry", {Deskewed: _as_parts(scans, clock), Labels: _as_parts(classes)})
    clock.start()
    track = odometry(chosen, *given)
    ms = clock.per_frame(len(track))
    extra = {
        "deskew_ms": _deskew_ms(recording),
        "deskew_io_ms": _deskew_files_ms(recording),
        "sensors_ms": _sensors_ms(recording), **_columns(track),
    }  # fmt: skip
    return Outcome(track.stamp_ns, track.T_odom_lidar, ms, float("nan"), 1, extra)


def _columns(track: Odometry) -> dict[str, Any]:
    names = ("covariance", "direction_p", "weak_directions", "degeneracy_d", "degeneracy_e", "reliable")
    return {name: getattr(track, name) for name in names}


class Clock:
    """When each frame was asked for; the last entry is the end."""

    def __init__(self) -> None:
        self.ticks: list[float] = []
        self.start()

    def start(self) -> None:
        """Begin to count."""
        self.started = time.perf_counter()

    def per_frame(self, frames: int) -> F8:
        """(frames,) ms: between two requests, scaled so that they sum up to the whole time."""
        whole = 1e3 * (time.perf_counter() - self.started)
        between = 1e3 * np.diff(self.ticks)
        if len(between) != frames - 1 or between.sum() <= 0:
            return np.full(frames, whole / frames)
        between = np.append(between, np.median(between))
        ms: F8 = between * whole / between.sum()
        return ms


def _flat(parts: Any) -> Iterator[Any]:
    return (item for part in parts for item in part)


def _as_parts(items: list[Any], clock: Clock | None = None) -> Parts[Any]:
    """All items as the one chunk of a session; `clock` notes when each is taken."""

    def noting() -> Iterator[Any]:
        for item in items:
            if clock:
                clock.ticks.append(time.perf_counter())
            yield item

    kind = Labels if hasattr(items[0], "class_") else Deskewed
    return Parts([((("session", "a"), ("chunk", "0000")), kind(noting()))])


def _deskew_ms(recording: Recording) -> F8:
    """(n,) ms of deskewing each scan, scans in memory, on one core."""
    from scanloom.stages.deskew import Settings, deskew

    ms: list[float] = []
    for part in recording.parts(Scans):
        scans = [*part]
        for _ in zip(range(2), deskew(Settings(), *recording.arguments("deskew", {Scans: Scans(scans)}))):
            pass  # compiled code is loaded
        given = recording.arguments("deskew", {Scans: Scans(scans)})
        started = time.perf_counter()
        for _ in deskew(Settings(), *given):
            now = time.perf_counter()
            ms.append(1e3 * (now - started))
            started = now
    return np.array(ms)


def _deskew_files_ms(recording: Recording) -> float:
    """Mean ms per scan of deskewing from files to files, on one core."""
    from scanloom.stages.deskew import Settings, deskew

    with tempfile.TemporaryDirectory() as folder:
        started, scans = time.perf_counter(), 0
        for part in recording.parts(Scans):
            flat = deskew(Settings(), *recording.arguments("deskew", {Scans: part}))
            scans += flat.write(Path(folder) / "deskewed.parquet")
        return 1e3 * (time.perf_counter() - started) / scans


def _sensors_ms(recording: Recording) -> float:
    """ms of holding the sensors of a session against its scans, once, from files, on one core; compiled code is loaded."""
    from scanloom.stages.sensors import Settings, sensors

    for _ in range(2):
        started = time.perf_counter()
        sensors(Settings(), *recording.arguments("sensors", {Scans: recording.parts(Scans)}))
    return 1e3 * (time.perf_counter() - started)


def on_one_core() -> None:
    """Whatever threads there are, they share one core from here on."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


# Peers ---------------------------------------------------------------------------------------------------------------


def _kiss_icp(recording: Recording, deskew: bool = True) -> Outcome:
    """KISS-ICP as it comes, all threads. With its own deskewing its poses hold for the end of the sweep: it moves each
    point by Exp((s - 1) * last motion), s from 0 to 1; without, for no instant in particular, the middle fits best."""
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.max_range = MAX_RANGE_M
    config.data.deskew = deskew
    system = KissICP(config)
    stamps: list[int] = []
    poses: list[F8] = []
    ms: list[float] = []
    for scan, scenery in scans_without_vehicle(recording, Scans):
        frame, share = scan.points()[scenery].astype(np.float64), _share_of_sweep(scan)[scenery]
        started = time.perf_counter()
        system.register_frame(frame, share)
        ms.append(1e3 * (time.perf_counter() - started))
        stamps.append(int(scan.stamp_ns.max()) if deskew else scan.reference_ns)
        poses.append(system.last_pose.copy())
    threads = len(os.sched_getaffinity(0))
    return Outcome(np.array(stamps, np.int64), np.array(poses), np.array(ms), _peak_mb(), threads)


def scans_without_vehicle(recording: Recording, kind: type[Any]) -> Iterator[tuple[Scan, NDArray[np.bool_]]]:
    """Scans, and which of their points are not the own vehicle nor under the least range: what any user would mask."""
    for scan, label in zip(_flat(recording.parts(kind)), _flat(recording.parts(Labels)), strict=True):
        near = (label.class_ == PointClass.OUT_OF_RANGE) & (np.linalg.norm(scan.points(), axis=1) < NEAR_M)
        yield scan, (label.class_ != PointClass.EGO) & ~near


def _share_of_sweep(scan: Scan) -> F8:
    """(n,) 0 at the first point of the sweep, 1 at the last."""
    first, last = int(scan.stamp_ns.min()), int(scan.stamp_ns.max())
    share: F8 = (scan.stamp_ns - first) / max(last - first, 1)
    return share


def _small_gicp(recording: Recording, voxel_m: float = 1.0, scans: str = "own") -> Outcome:
    """VGICP, scan to Gaussian voxel map, one thread, start from constant velocity.

    scans : `own`, deskewed by the last motion as KISS-ICP does; `ours`, deskewed by our stage. Deskewing is not timed.
    A scan enters the map after 0.5 m of way: with every scan it is worse on most sequences, standing still above all.
    """
    import small_gicp

    from scanloom.stages.geometry.compensation import compensate
    from scanloom.stages.geometry.motion import MotionTrack

    still = MotionTrack.build(Imu.empty(), Wheel.empty(), recording.one(Session))
    local_map, inserted = small_gicp.GaussianVoxelMap(voxel_m), np.full(3, np.inf)
    T, motion, last_ns = np.eye(4), np.eye(4), 0
    stamps: list[int] = []
    poses: list[F8] = []
    ms: list[float] = []
    for scan, scenery in scans_without_vehicle(recording, Scans if scans == "own" else Deskewed):
        points = scan.points()
        if scans == "own" and poses:
            twist = se3_log(motion) / (1e-9 * (scan.reference_ns - last_ns))
            moved = compensate(scan.stamp_ns, scan.x_m, scan.y_m, scan.z_m, scan.reference_ns, still, twist)
            points = np.column_stack(moved)
        points = points[scenery & (np.linalg.norm(points, axis=1) < MAX_RANGE_M)].astype(np.float64)
        started = time.perf_counter()
        cloud, _ = small_gicp.preprocess_points(
            points, downsampling_resolution=0.25, num_neighbors=10, num_threads=1
        )
        if poses:
            found = small_gicp.align(local_map, cloud, T @ motion, num_threads=1)
            if found.num_inliers < LOST_SHARE * cloud.size():
                break
            now = _orthonormal(found.T_target_source)
            T, motion = now, inverse(T) @ now
        if not np.linalg.norm(T[:3, 3] - inserted) < INSERT_M:
            local_map.insert(cloud, T)
            inserted = T[:3, 3]
        ms.append(1e3 * (time.perf_counter() - started))
        last_ns = scan.reference_ns
        stamps.append(scan.reference_ns)
        poses.append(T.copy())
    return Outcome(np.array(stamps, np.int64), np.array(poses), np.array(ms), _peak_mb(), 1)


def _orthonormal(T: F8) -> F8:
    """A copy whose rotation is one: what VGICP returns is off by rounding, and a start at constant velocity doubles
    that with every scan."""
    left, _, right = np.linalg.svd(T[:3, :3])
    return pose(left @ right, T[:3, 3])


def _peak_mb() -> float:
    """Largest resident memory of this process; unlike `getrusage` it knows nothing of the parent's."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return float(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    order = json.loads(Path(sys.argv[1]).read_text())
    recording = Recording(**order["recording"])
    run(order["program"], recording, order["options"]).write(Path(order["out"]))


if __name__ == "__main__":
    main()
