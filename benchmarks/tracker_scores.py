"""What the boxes of the tracker are worth, against the simulator's own list of what moves, or boxes drawn by hand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.scores import Score
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.scans import DeskewedScan, PointClass, ScanLabels
from scanloom.stages.geometry.boxes import inside_boxes
from scanloom.stages.geometry.se3 import F8

RANGE_M = 40.0
MARGIN_M = 0.3
VEHICLES = ("car", "truck", "bus", "van")
UNTOLD = (PointClass.EGO, PointClass.OUT_OF_RANGE, PointClass.GROUND)
"""Points of these labels are nobody's to take away."""
FALSE_SHARE = 0.5
"""A track most of whose points are truly of things that stand is a false alarm."""
LEAST_PARKED = 20
"""Points of a parked car in a box from which on it counts as taken for moving, if they are a fifth of its own."""


@dataclass
class Tally:
    """Counts over a drive."""

    moving: dict[int, int] = field(default_factory=dict)
    """Points of everything that moves, by its number."""
    covered: dict[int, int] = field(default_factory=dict)
    waiting: int = 0
    waiting_covered: int = 0
    standing: int = 0
    taken: int = 0
    by_track: dict[int, list[int]] = field(default_factory=dict)
    """Points that truly move and that truly stand, by track."""
    parked: dict[int, int] = field(default_factory=dict)
    """Points of standing instances, by number."""
    parked_taken: dict[int, int] = field(default_factory=dict)
    speed_errors: list[float] = field(default_factory=list)
    times: list[float] = field(default_factory=list)


class Judge:
    """Holds a track table against truth, scan by scan."""

    def __init__(self, tracks: ObjectTracks, kinds: Mapping[int, str]) -> None:
        self.tally = Tally()
        self._kinds = kinds
        self._tracks = tracks
        self._boxes = tracks.boxes()

    def add(
        self, scan: DeskewedScan, label: ScanLabels, true_class: NDArray[np.uint8], instance: NDArray[np.uint16],
        speeds: Mapping[int, float],
    ) -> None:  # fmt: skip
        """One scan: true class and instance (n,) of its points; speeds of what moves, m/s."""
        first, last = np.searchsorted(self._tracks.scan_index, [scan.scan_index, scan.scan_index + 1])
        rows = np.arange(first, last)[self._tracks.dynamic[first:last]]
        box = inside_boxes(scan.x_m, scan.y_m, scan.z_m, np.ascontiguousarray(self._boxes[rows]), MARGIN_M)
        judged = ~np.isin(label.class_, UNTOLD) & (np.hypot(scan.x_m, scan.y_m) < RANGE_M)
        moving = judged & (true_class == PointClass.DYNAMIC)
        standing = judged & np.isin(true_class, (PointClass.STATIC, PointClass.GROUND))
        t = self.tally
        t.standing += int(standing.sum())
        t.taken += int((standing & (box >= 0)).sum())
        for number in np.unique(instance[moving]):
            own = moving & (instance == number)
            inside = int((own & (box >= 0)).sum())
            t.moving[number] = t.moving.get(number, 0) + int(own.sum())
            t.covered[number] = t.covered.get(number, 0) + inside
            if speeds.get(number, 1.0) < 0.1:
                t.waiting += int(own.sum())
                t.waiting_covered += inside
            self._speed(own, number, box, rows, speeds)
        for number in np.unique(instance[standing & (instance > 0)]):
            own = standing & (instance == number)
            t.parked[number] = t.parked.get(number, 0) + int(own.sum())
            t.parked_taken[number] = t.parked_taken.get(number, 0) + int((own & (box >= 0)).sum())
        for k, row in enumerate(rows):
            counts = t.by_track.setdefault(int(self._tracks.track[row]), [0, 0])
            counts[0] += int((moving & (box == k)).sum())
            counts[1] += int((standing & (box == k)).sum())

    def _speed(self, own: NDArray[np.bool_], number: int, box: NDArray[np.int32], rows: NDArray[np.intp], speeds: Mapping[int, float]) -> None:  # fmt: skip
        """The error of the speed of the box that holds most points of a vehicle."""
        if self._kinds.get(number, "") not in VEHICLES or number not in speeds:
            return
        held = box[own & (box >= 0)]
        if len(held) >= 5:
            row = rows[np.bincount(held).argmax()]
            self.tally.speed_errors.append(float(self._tracks.speed_m_s[row]) - speeds[number])

    def scores(self) -> Iterator[Score]:
        """The figures."""
        t = self.tally
        vehicles = [n for n in t.moving if self._kinds.get(n, "") in VEHICLES]
        others = [n for n in t.moving if n not in vehicles]
        where = (
            f"not labelled ground, within {RANGE_M:g} m, by true instance; boxes widened by {MARGIN_M:g} m"
        )
        yield Score(
            "vehicles_covered_percent",
            self._share(vehicles),
            "%",
            f"points of moving vehicles in a box; {where}",
        )
        yield Score(
            "others_covered_percent",
            self._share(others),
            "%",
            f"points of people, cyclists and the like in a box; {where}",
        )
        yield Score("waiting_covered_percent", 100.0 * t.waiting_covered / t.waiting if t.waiting else np.nan, "%",
                    "points in a box, of what stood still at the time and moves at another")  # fmt: skip
        yield Score(
            "standing_taken_percent",
            100.0 * t.taken / max(t.standing, 1),
            "%",
            "points of what stands that are in a box",
        )
        false = [n for n, (a, b) in t.by_track.items() if b > FALSE_SHARE * (a + b)]
        yield Score("tracks", len(t.by_track), "", "tracks of something that moves")
        yield Score("false_tracks", len(false), "", "tracks of which most points are of things that stand")
        taken = [
            n for n, k in t.parked_taken.items()
            if k >= max(LEAST_PARKED, 0.2 * t.parked[n]) and n not in t.moving and self._kinds.get(n, "car") in VEHICLES
        ]  # fmt: skip
        yield Score("parked_taken", len(taken), "", "parked cars with a fifth of their points in a box")
        errors = np.abs(t.speed_errors)
        yield Score(
            "speed_error_median_m_s",
            float(np.median(errors)) if len(errors) else np.nan,
            "m/s",
            "of vehicles in a box, scan by scan",
        )
        yield Score(
            "speed_error_p90_m_s",
            float(np.quantile(errors, 0.9)) if len(errors) else np.nan,
            "m/s",
            "the same, 90th percentile",
        )

    def _share(self, numbers: list[int]) -> float:
        total = sum(self.tally.moving[n] for n in numbers)
        return 100.0 * sum(self.tally.covered[n] for n in numbers) / total if total else float("nan")


def speeds_of(scan_index: int, tracks_scan: NDArray[np.int64], instance: NDArray[np.uint16], speed: F8) -> dict[int, float]:  # fmt: skip
    """Speed by instance in one scan."""
    first, last = np.searchsorted(tracks_scan, [scan_index, scan_index + 1])
    return {int(n): float(v) for n, v in zip(instance[first:last], speed[first:last])}
