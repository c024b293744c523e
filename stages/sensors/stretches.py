"""Short stretches of a session in which its sensors have most to say, and the motion between the scans there."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.scans import Scan, Scans
from scanloom.stages.geometry.motion import I8, MotionTrack
from scanloom.stages.geometry.neighbours import ThinScan, twist_between
from scanloom.stages.geometry.se3 import F8

STRETCH = 12
"""Pairs of scans in a row."""
LEAST_READINGS = 8


@dataclass(frozen=True)
class Place:
    """Where a scan lies: part of the session, number in the part, its reference time, its points."""

    part: int
    number: int
    reference_ns: int
    points: int


@dataclass(frozen=True)
class Motions:
    """Mean twists (m, 6) of the LiDAR between scans, the reference times of the two (m,), and the two."""

    start_ns: I8
    end_ns: I8
    twist: F8
    scans: tuple[tuple[ThinScan, ThinScan], ...]

    @classmethod
    def of(cls, rows: list[tuple[ThinScan, ThinScan, F8]]) -> Motions:
        return cls(
            np.array([a.reference_ns for a, _, _ in rows], np.int64),
            np.array([b.reference_ns for _, b, _ in rows], np.int64),
            np.array([twist for _, _, twist in rows], float).reshape(-1, 6),
            tuple((a, b) for a, b, _ in rows),
        )

    def again(self, track: MotionTrack) -> Motions:
        """Registered once more with the turn rates of a gyro that is right.

        Within a sweep they change, which the scans alone do not show: at 2 rad/s2 that falsifies the speed by 0.3 m/s.
        """
        twists = [twist_between(a, b, track, t) for (a, b), t in zip(self.scans, self.twist, strict=True)]
        known = [(a, b, t) for (a, b), t in zip(self.scans, twists, strict=True) if t is not None]
        return Motions.of(known)


def places(scans: Sequence[Scans]) -> list[Place]:
    """All scans of a session in order, without reading a point."""
    return [
        Place(k, i, int(entry["reference_ns"]), int(entry["rows"]))
        for k, part in enumerate(scans)
        for i, entry in enumerate(part.index)
    ]


def liveliest(reference_ns: I8, stamp_ns: I8, value: F8, count: int, taken: set[int]) -> list[int]:
    """First scans of `count` stretches in which the readings (n, c) vary most, apart from those in `taken`."""
    starts = np.arange(0, max(len(reference_ns) - STRETCH, 1), STRETCH // 2)
    last = np.minimum(starts + STRETCH, len(reference_ns) - 1)
    i, j = np.searchsorted(stamp_ns, reference_ns[starts]), np.searchsorted(stamp_ns, reference_ns[last])
    spread = np.array([_spread(value[a:b]) for a, b in zip(i, j, strict=True)])
    found: list[int] = []
    for k in np.argsort(-spread, kind="stable"):
        start = int(starts[k])
        if len(found) < count and spread[k] > 0 and all(abs(start - t) >= STRETCH for t in taken):
            taken.add(start)
            found.append(start)
    return found


def motions(scans: Sequence[Scans], where: list[Place], starts: list[int], track: MotionTrack) -> Motions:
    """Register the neighbours of each stretch, two stretches at a time; pairs that do not fit are left out."""
    stretches = [where[start : start + STRETCH + 1] for start in sorted(starts)]
    with ThreadPoolExecutor(2, thread_name_prefix="stretch") as threads:
        found = threads.map(lambda stretch: _stretch(scans, stretch, track), stretches)
        rows = [row for stretch in found for row in stretch]
    return Motions.of(rows)


def _stretch(
    scans: Sequence[Scans], where: list[Place], track: MotionTrack
) -> list[tuple[ThinScan, ThinScan, F8]]:
    rows: list[tuple[ThinScan, ThinScan, F8]] = []
    before: ThinScan | None = None
    guess: F8 | None = None
    for place in where:
        scan: Scan = scans[place.part][place.number]
        thin = ThinScan.of(scan)
        if before is not None:
            guess = twist_between(before, thin, track, guess)
            if guess is not None:
                rows.append((before, thin, guess))
        before = thin
    return rows


def _spread(value: F8) -> float:
    """Standard deviation of all columns together, m or rad per s; zero where there is hardly a reading."""
    return float(np.sqrt(value.var(axis=0).sum())) if len(value) >= LEAST_READINGS else 0.0
