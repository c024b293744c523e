"""The tracker against truth: how much of what moves its boxes cover, and what of the rest they take.

Simulated towns on a busy day with 32 and 64 beams, one without traffic, and KITTI 0005 with boxes drawn by hand.
Run: python -m benchmarks.tracker [--scenes busy_32 ...] [--data ../shared/data] [--store FOLDER] [--json - or FILE]
Figures: bench.tracker.<scene>.<name>.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.clean_boxes import LABELS, read_boxes
from benchmarks.clean_boxes import boxed as in_boxes
from benchmarks.figures import published
from benchmarks.scores import Figure, Score
from benchmarks.sequences import KITTI, Drive, produced
from benchmarks.tracker_scores import Judge, speeds_of
from scanloom.pipeline.run import Result
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels, TruePoints
from scanloom.schemas.session import Session, TruthLog
from scanloom.schemas.simulated import TrueObjects, TrueTracks
from scanloom.schemas.trajectory import Odometry, Truth
from scanloom.stages.objects import Settings, objects

MADE = (Deskewed, Labels, Session, Odometry)
_BUSY: dict[str, Any] = {"busy": True, "duration_s": 40.0}
DRIVES = {
    "busy_32": {**_BUSY, "beams": 32},
    "busy_32_b": {**_BUSY, "beams": 32, "start_m": 300.0, "seed": 2},
    "busy_64": {**_BUSY, "beams": 64, "start_m": 20.0, "duration_s": 25.0, "seed": 1},
    "quiet_32": {"traffic": False, "duration_s": 40.0, "seed": 3},
}
KITTI_0005 = "kitti_0005"


def main() -> None:
    options = _options()
    figures: list[Figure] = []
    for scene in options.scenes:
        folder = options.data / KITTI
        if scene == KITTI_0005 and not folder.exists():
            print(f"{scene}: there is no {folder}")
            continue
        found = _kitti(folder, options.store) if scene == KITTI_0005 else _town(scene, options.store)
        figures += [
            Figure(f"bench.tracker.{scene}.{s.name}", s.value, s.unit, "session", s.method) for s in found
        ]
    published(figures, options.json)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = [*DRIVES, KITTI_0005]
    parser.add_argument("--scenes", nargs="+", choices=known, default=known)
    parser.add_argument(
        "--data", type=Path, default=Path("../shared/data"), help="folder with kitti_raw_0005"
    )
    parser.add_argument("--store", type=Path, default=Path("build/bench/store"))
    parser.add_argument("--json", default="", help="file, or - for standard output")
    return parser.parse_args()


def _town(scene: str, store: Path) -> Iterator[Score]:
    """A simulated drive, with the simulator's lists as truth."""
    result = produced(Drive(scene, scene, DRIVES[scene]), (*MADE, Truth), store)
    tracks, score = _timed(result)
    yield score
    ((_, log),) = result.files(TruthLog)
    moving, standing = TrueTracks.open(log / "tracks.parquet"), TrueObjects.open(log / "objects.parquet")
    kinds = {int(n): str(what) for n, what in zip(standing.instance, standing.what)}
    kinds |= {int(n): str(what) for n, what in zip(moving.instance, moving.what)}
    judge = Judge(tracks, kinds)
    for (scan, label), true in zip(_scans(result), TruePoints.open(log / "points.parquet")):
        speeds = speeds_of(scan.scan_index, moving.scan_index, moving.instance, moving.speed_m_s)
        judge.add(scan, label, true.class_, true.instance, speeds)
    yield from judge.scores()


def _kitti(folder: Path, store: Path) -> Iterator[Score]:
    """A real drive, with boxes in the camera's view as truth; what is in none is not judged."""
    result = produced(Drive(KITTI_0005, KITTI, folder=folder), MADE, store)
    tracks, score = _timed(result)
    yield score
    boxes = read_boxes(folder / LABELS, result.parts(Odometry)[0].T_odom_lidar)
    judge = Judge(tracks, {box.number: box.what.lower() for box in boxes})
    for scan, label in _scans(result):
        judge.add(scan, label, *in_boxes(scan, boxes, PointClass.OUT_OF_RANGE), {})
    yield from judge.scores()


def _timed(result: Result) -> tuple[ObjectTracks, Score]:
    """The tracks, and the time that they took in a second run."""
    read = result.parts(Deskewed), result.parts(Labels), result.parts(Session)[0], result.parts(Odometry)[0]
    tracks = objects(Settings(), *read)
    start = time.process_time()
    objects(Settings(), *read)
    took = 1e3 * (time.process_time() - start) / max(len(read[3]), 1)
    return tracks, Score("ms_per_scan", took, "ms", "processor time of the stage, reading of scans included")


def _scans(result: Result) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    for scans, labels in zip(result.parts(Deskewed), result.parts(Labels)):
        yield from zip(scans, labels)


if __name__ == "__main__":
    main()
