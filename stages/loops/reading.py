"""Scans of keyframes with their labels, read one at a time from streams in files."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Places
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, ScanLabels


def keyframe_scans(
    deskewed: Deskewed, labels: Labels, wanted: Collection[int]
) -> Iterator[tuple[DeskewedScan, ScanLabels]]:
    """Scans of one chunk whose number is in `wanted`, in sequence, with their labels; others are not read.

    Raises
    ------
    StageError : labels do not fit the scans.
    """
    for place, entry in enumerate(deskewed.index):
        if entry["scan_index"] in wanted:
            yield _pair(deskewed, labels, place)


def joined(chunks: Sequence[Places]) -> Places:
    """The places of all chunks of a session as one table, in sequence."""
    return Places.concatenate(chunks)


class ScanShelf:
    """Where each scan of one session lies, so that single scans can be read in any order."""

    def __init__(self, deskewed: Parts[Deskewed], labels: Parts[Labels]) -> None:
        self._chunks = list(_chunks(deskewed, labels))
        self._place: dict[int, tuple[int, int]] = {}
        for number, (cloud, _) in enumerate(self._chunks):
            for place, entry in enumerate(cloud.index):
                self._place[int(entry["scan_index"])] = (number, place)

    def read(self, scan_index: int) -> tuple[DeskewedScan, ScanLabels]:
        """One scan and its labels.

        Raises
        ------
        StageError : the session holds no such scan, or its labels do not fit.
        """
        if scan_index not in self._place:
            raise StageError(
                f"there is no deskewed scan {scan_index}",
                next_step="run deskew again; odometry and scans do not match",
            )
        number, place = self._place[scan_index]
        return _pair(*self._chunks[number], place)


def _chunks(deskewed: Parts[Deskewed], labels: Parts[Labels]) -> Sequence[tuple[Deskewed, Labels]]:
    if len(deskewed) != len(labels):
        raise StageError(
            f"{len(deskewed)} chunks of scans but {len(labels)} chunks of labels",
            next_step="run denoise again",
        )
    return list(zip(deskewed, labels, strict=True))


def _pair(cloud: Deskewed, classes: Labels, place: int) -> tuple[DeskewedScan, ScanLabels]:
    scan, label = cloud[place], classes[place]
    if len(scan) != len(label) or scan.scan_index != label.scan_index:
        raise StageError(
            f"labels of scan {label.scan_index} ({len(label)} points) do not fit scan {scan.scan_index} ({len(scan)} points)",
            next_step="run denoise again",
        )
    return scan, label
