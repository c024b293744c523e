"""Windows: a long session cut into stretches that overlap, tracked side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, ScanLabels

LEAST_SCANS = 10
"""Of an overlap."""
LEAST_LENGTHS = 2
"""A window is at least this many overlaps long: otherwise most of the work would be done twice."""


@dataclass(frozen=True)
class Window:
    """Scans `first` to `last` - 1 of a session; those before `own` are the window's before it, too."""

    first: int
    own: int
    last: int


def cut(stamp_ns: NDArray[np.int64], windows: int, overlap_s: float) -> list[Window]:
    """At most `windows` stretches of equal number of scans, each reaching `overlap_s` back into the one before it.

    It reaches back by some scans at least, also over a pause, and never beyond the window before it.
    """
    n = len(stamp_ns)
    length_s = 1e-9 * float(stamp_ns[-1] - stamp_ns[0]) if n else 0.0
    most = min(int(length_s / (LEAST_LENGTHS * overlap_s)), n // (LEAST_LENGTHS * LEAST_SCANS))
    edges = np.round(np.linspace(0, n, max(1, min(windows, most)) + 1)).astype(int)
    found = [Window(0, 0, int(edges[1]))]
    for before, own, last in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        back = int(np.searchsorted(stamp_ns, stamp_ns[own] - round(overlap_s * 1e9)))
        found.append(Window(max(min(back, int(own) - LEAST_SCANS), int(before)), int(own), int(last)))
    return found


def stamps(deskewed: Parts[Deskewed]) -> NDArray[np.int64]:
    """Reference time (n,) of every scan, without reading a point."""
    return np.array([entry["reference_ns"] for chunk in deskewed for entry in chunk.index], np.int64)


def scans_of(
    deskewed: Parts[Deskewed], labels: Parts[Labels], window: Window | None, session: str
) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    """Scans with their labels: all of a session, or those of a window; others are not read.

    Raises
    ------
    StageError : labels that do not belong to the scans.
    """
    begin = 0
    for clouds, classes in zip(deskewed, labels, strict=True):
        pairs: Iterator[tuple[DeskewedScan, ScanLabels]]
        if window is None:
            pairs = zip(clouds, classes, strict=True)
        else:
            part = range(max(window.first - begin, 0), min(window.last - begin, len(clouds)))
            begin += len(clouds)
            pairs = _some(clouds, classes, part)
        for scan, label in pairs:
            if len(scan) != len(label) or scan.scan_index != label.scan_index:
                raise StageError(
                    f"labels of scan {label.scan_index} do not belong to scan {scan.scan_index}",
                    where=f"session {session}",
                    next_step="run `scanloom verify`, then map again",
                )
            yield scan, label


def _some(
    clouds: Deskewed, classes: Labels, part: Sequence[int]
) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    if len(part) == len(clouds):
        yield from zip(clouds, classes, strict=True)
    else:
        yield from ((clouds[k], classes[k]) for k in part)
