"""What is truly there, scan by scan: by the simulator, which knows it, or by boxes that people drew."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.clean_boxes import BoxTrack, boxed
from benchmarks.clean_scores import UNJUDGED
from scanloom.schemas.scans import DeskewedScan, PointClass, TruePoints
from scanloom.schemas.simulated import TrueObjects, TrueTracks

RESTS_M_S, DRIVES_M_S, WAITS_SCANS = 0.1, 1.0, 30

Kinds = dict[str, list[int]]
"""Numbers of the objects of each kind; one may be of several."""
Known = tuple[NDArray[np.uint8], NDArray[np.uint16]]
"""True class and number of the object (n,) of the points of a scan."""


def simulated(log: Path, scans: Iterator[DeskewedScan]) -> Iterator[Known]:
    """What the simulator says of each scan, from the folder of its truth."""
    for scan, true in zip(scans, TruePoints.open(log / "points.parquet")):
        if len(scan) != len(true) or scan.scan_index != true.scan_index:
            raise SystemExit(f"truth of scan {true.scan_index} is not that of scan {scan.scan_index}")
        yield true.class_, true.instance


def kinds_simulated(log: Path) -> Kinds:
    """What stands about and what moves in the simulator's world."""
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


def measured(tracks: list[BoxTrack], scans: Iterator[DeskewedScan]) -> Iterator[Known]:
    """What boxes say of each scan; what is in none is not judged."""
    return (boxed(scan, tracks, UNJUDGED) for scan in scans)


def kinds_measured(tracks: list[BoxTrack]) -> Kinds:
    """What the boxes are of, moving or parked."""
    kinds: Kinds = {}
    for track in tracks:
        name = f"{'moving' if track.moving else 'parked'}_{track.what.lower()}"
        kinds.setdefault(name, []).append(track.number)
    return kinds
