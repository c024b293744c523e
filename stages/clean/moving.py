"""Boxes of what the tracker saw move, scan by scan, and which points of a scan are theirs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.scans import DeskewedScan
from scanloom.stages.geometry.boxes import box_at, inside_boxes, near_boxes
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I4 = NDArray[np.int32]


class MovingBoxes:
    """The rows of the tracks that are dynamic, by scan."""

    def __init__(self, tracks: ObjectTracks) -> None:
        moving = tracks.take(tracks.dynamic)
        order = np.argsort(moving.scan_index, kind="stable")
        self._scan_index, self._boxes = moving.scan_index[order], moving.boxes()[order]

    def of(self, scan: DeskewedScan) -> F8:
        """Boxes (m, 15) of what moves in a scan, as `inside_boxes` reads them."""
        first, last = np.searchsorted(self._scan_index, [scan.scan_index, scan.scan_index + 1])
        return self._boxes[first:last]


class Boxed(NamedTuple):
    """Where the returns (n,) of a scan are among the boxes of what moves."""

    number: I4
    """Of the box that they lie in, -1 for none."""
    around: B1
    """In one or close to it."""
    above: B1
    """In one and above its foot."""


def boxed(scan: DeskewedScan, boxes: F8, margin_m: float) -> B1:
    """Points (n,) of a scan within `margin_m` of one of the boxes (m, 15)."""
    return np.asarray(inside_boxes(scan.x_m, scan.y_m, scan.z_m, boxes, margin_m) >= 0)


def where_boxed(scan: DeskewedScan, boxes: F8, margin_m: float, wide_m: float, foot_m: float) -> Boxed:
    """Points of a scan within `margin_m` of one of the boxes (m, 15), of these at least `foot_m` above its foot; and within
    `wide_m` of one."""
    raised = boxes.copy()
    raised[:, [3, 7, 11]] += foot_m * boxes[:, [2, 6, 10]]
    raised[:, 14] = np.maximum(boxes[:, 14] - foot_m, 0.0)
    return Boxed(*_where(scan.x_m, scan.y_m, scan.z_m, boxes, raised, margin_m, wide_m, foot_m))


@kernel
def _where(
    x: F4, y: F4, z: F4, boxes: F8, raised: F8, margin_m: float, wide_m: float, foot_m: float
) -> tuple[I4, B1, B1]:
    number, above = np.full(len(x), -1, np.int32), np.zeros(len(x), np.bool_)
    widest_m = max(margin_m, wide_m) + foot_m
    around = near_boxes(x, y, z, boxes, widest_m)
    for n in range(len(x)):
        if not around[n]:
            continue
        px, py, pz = float(x[n]), float(y[n]), float(z[n])
        around[n] = False
        if box_at(px, py, pz, boxes, widest_m) >= 0:
            number[n] = box_at(px, py, pz, boxes, margin_m)
            above[n] = box_at(px, py, pz, raised, margin_m) >= 0
            around[n] = box_at(px, py, pz, boxes, wide_m) >= 0
    return number, around, above
