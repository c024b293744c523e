"""Boxes of what the tracker saw move, scan by scan, and which points of a scan are theirs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.scans import DeskewedScan
from scanloom.stages.geometry.boxes import inside_boxes
from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]
I4 = NDArray[np.int32]


class MovingBoxes:
    """The rows of the tracks that are dynamic, by scan."""

    def __init__(self, tracks: ObjectTracks) -> None:
        moving = tracks.take(tracks.dynamic)
        self._tracks = moving.take(np.argsort(moving.scan_index, kind="stable"))

    def of(self, scan: DeskewedScan) -> F8:
        """Boxes (m, 15) of what moves in a scan, as `inside_boxes` reads them."""
        first, last = np.searchsorted(self._tracks.scan_index, [scan.scan_index, scan.scan_index + 1])
        return self._tracks.take(slice(first, last)).boxes()


def boxed(scan: DeskewedScan, boxes: F8, margin_m: float, above_m: float = 0.0) -> B1:
    """Points (n,) of a scan within `margin_m` of one of the boxes (m, 15) and at least `above_m` above its foot."""
    if not len(boxes):
        return np.zeros(len(scan), np.bool_)
    raised = boxes.copy()
    raised[:, [3, 7, 11]] += above_m * boxes[:, [2, 6, 10]]
    raised[:, 14] = np.maximum(boxes[:, 14] - above_m, 0.0)
    return number_of_box(scan, raised, margin_m) >= 0


def number_of_box(scan: DeskewedScan, boxes: F8, margin_m: float) -> I4:
    """Number (n,) of the box (m, 15) that each point of a scan is within `margin_m` of, -1 for none."""
    if not len(boxes):
        return np.full(len(scan), -1, np.int32)
    return np.asarray(inside_boxes(scan.x_m, scan.y_m, scan.z_m, boxes, margin_m))
