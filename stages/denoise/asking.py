"""What neighbouring scans tell of a point: whether they meet it again, and whether they look through it (methods 1.5.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.denoise.frame import places_from
from scanloom.stages.denoise.window import Moment
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import inverse

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

NEAR, FAR = (-2, -1, 1, 2), (-8, -5, 5, 8)
"""Scans that are asked whether a point is still there."""
MET = 5
"""Answers from here on: some of them meet it."""
NOT_ASKED = 25
"""Answer of scans that are not there."""
LOOKED_THROUGH = 6
"""Cells of nine around a place that show nothing, or something behind it."""
SAME_M, SAME_PER_M, BEYOND_M, BEYOND_PER_M = (np.float32(c) for c in (0.2, 0.01, 0.3, 0.02))
"""A neighbouring scan meets a point again within the first pair; what it sees behind it is farther by the second."""
WHOLE = np.uint64
"""Of cells that are looked up: a signed number is asked each time whether it counts from the end."""


def answers(moment: Moment, offsets: tuple[int, ...], asked: I8) -> U1:
    """Answers (m,) of the scans at `offsets` on the points `asked`: in how many fourths of them each is met again, times
    five, and seen through."""
    known = moment.known(*offsets)
    if not known or not len(asked):
        return np.full(len(asked), NOT_ASKED, np.uint8)
    scan, votes = moment.view.scan, np.zeros((len(asked), 2), np.uint8)
    for view, T_scan_neighbour in known:
        frame = view.frame
        _ask(
            scan.x_m, scan.y_m, scan.z_m, asked, inverse(T_scan_neighbour).astype(np.float32), frame.row_start,
            frame.columns, frame.range_m, frame.stride, votes,
        )  # fmt: skip
    fourths: U1 = np.rint(4.0 * np.arange(len(known) + 1) / len(known)).astype(np.uint8)
    said: U1 = _said(votes, fourths)
    return said


def met_again(moment: Moment, asked: I8) -> B1:
    """Which of the points `asked` (m,) a neighbouring scan has a point near, too; none when no scan can be asked."""
    out, left = np.zeros(len(asked), np.bool_), np.arange(len(asked))
    for offsets in (NEAR, FAR):
        said = answers(moment, offsets, asked[left])
        met = (said >= MET) & (said < NOT_ASKED)
        out[left[met]] = True
        left = left[~met]
    return out


@kernel
def _ask(
    x: F4, y: F4, z: F4, asked: I8, T: F4, row_start: I4, columns: int, ranges: F4, stride: int, votes: U1
) -> None:  # fmt: skip
    """Adds one to votes (m, 2) of the points met again, and of those looked through, in one neighbouring scan."""
    a, b, c = _taken(x, y, z, asked)
    place, away = places_from(a, b, c, T, row_start, columns)
    step = WHOLE(stride)
    for m in range(len(place)):
        k, r = WHOLE(place[m]), away[m]
        same, beyond = SAME_M + SAME_PER_M * r, r + (BEYOND_M + BEYOND_PER_M * r)
        met, behind = 0, 0
        first = k - step - WHOLE(1)
        for i in range(WHOLE(3)):
            for j in range(WHOLE(3)):
                range_m = ranges[first + i * step + j]
                met += abs(range_m - r) < same
                behind += range_m > beyond
        votes[m, 0] += met > 0
        votes[m, 1] += behind >= LOOKED_THROUGH


@kernel
def _taken(x: F4, y: F4, z: F4, rows: I8) -> tuple[F4, F4, F4]:
    """Coordinates of the points `rows` (m,)."""
    a, b, c = (
        np.empty(len(rows), np.float32),
        np.empty(len(rows), np.float32),
        np.empty(len(rows), np.float32),
    )
    for m in range(len(rows)):
        a[m], b[m], c[m] = x[rows[m]], y[rows[m]], z[rows[m]]
    return a, b, c


@kernel
def _said(votes: U1, fourths: U1) -> U1:
    out = np.empty(len(votes), np.uint8)
    for m in range(len(out)):
        out[m] = MET * fourths[votes[m, 0]] + fourths[votes[m, 1]]
    return out
