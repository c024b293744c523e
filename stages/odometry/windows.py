"""Windows: a long session cut into stretches that overlap, each of which is tracked on its own worker.

With `odometry.windows` below 2, or a session too short for its overlaps, nothing is cut: then there is no window, and
odometry tracks the session in one go.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, ScanLabels, Scans
from scanloom.schemas.windows import Window
from scanloom.stages.odometry.settings import Cutting

__all__ = ["VERSION", "Settings", "cut", "scans_of", "windows"]

VERSION = 1
Settings = Cutting

LEAST_SCANS = 10
"""Of an overlap."""
LEAST_LENGTHS = 2
"""A window is at least this many overlaps long: otherwise most of the work would be done twice."""


def windows(settings: Cutting, scans: Parts[Scans]) -> Iterator[Part[Window]]:
    """The windows of a session, from the times of its scans; none when it is not cut. No point is read."""
    if settings.windows < 2:
        return
    times = [np.array([entry["reference_ns"] for entry in chunk.index], np.int64) for chunk in scans]
    begins = np.cumsum([0, *map(len, times)])
    found = cut(
        np.concatenate(times) if times else np.zeros(0, np.int64), settings.windows, settings.window_overlap_s
    )
    for number, window in enumerate(found if len(found) > 1 else ()):
        chunk = int(np.searchsorted(begins, window.first, side="right")) - 1
        yield Part(
            window.model_copy(update={"chunk": chunk, "chunk_first": int(begins[chunk])}), f"{number:04d}"
        )


def cut(stamp_ns: NDArray[np.int64], count: int, overlap_s: float) -> list[Window]:
    """At most `count` stretches, each reaching `overlap_s` back into the one before it, with equal numbers of scans to track.

    A stretch reaches back by some scans at least, also over a pause, and never beyond the window before it.
    """
    n = len(stamp_ns)
    length_s = 1e-9 * float(stamp_ns[-1] - stamp_ns[0]) if n else 0.0
    most = min(int(length_s / (LEAST_LENGTHS * overlap_s)), n // (LEAST_LENGTHS * LEAST_SCANS))
    reach = n * overlap_s / length_s if most > 1 else 0.0
    edges = np.round(np.linspace(reach, n, max(1, min(count, most)) + 1)).astype(int)
    edges[0] = 0
    found = [Window(first=0, own=0, last=int(edges[1]))]
    for before, own, last in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        back = int(np.searchsorted(stamp_ns, stamp_ns[own] - round(overlap_s * 1e9)))
        first = max(min(back, int(own) - LEAST_SCANS), int(before))
        found.append(Window(first=first, own=int(own), last=int(last)))
    return found


def scans_of(
    deskewed: Parts[Deskewed], labels: Parts[Labels], window: Window | None, session: str
) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    """Scans with their labels: all of a session, or those of a window; chunks without any of these are not opened.

    Raises
    ------
    StageError : labels that do not belong to the scans.
    """
    for scan, label in _pairs(deskewed, labels) if window is None else _pairs_in(deskewed, labels, window):
        if len(scan) != len(label) or scan.scan_index != label.scan_index:
            raise StageError(
                f"labels of scan {label.scan_index} do not belong to scan {scan.scan_index}",
                where=f"session {session}",
                next_step="run `scanloom verify`, then map again",
            )
        yield scan, label


def _pairs(deskewed: Parts[Deskewed], labels: Parts[Labels]) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    for clouds, classes in zip(deskewed, labels, strict=True):
        yield from zip(clouds, classes, strict=True)


def _pairs_in(
    deskewed: Parts[Deskewed], labels: Parts[Labels], window: Window
) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    begin = window.chunk_first
    for k in range(window.chunk, len(deskewed)):
        if begin >= window.last:
            return
        clouds, classes = deskewed[k], labels[k]
        yield from _some(
            clouds, classes, range(max(window.first - begin, 0), min(window.last - begin, len(clouds)))
        )
        begin += len(clouds)


def _some(
    clouds: Deskewed, classes: Labels, part: Sequence[int]
) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    if len(part) == len(clouds):
        yield from zip(clouds, classes, strict=True)
    else:
        yield from ((clouds[k], classes[k]) for k in part)
