"""Accepted loops as links between keyframes of drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.geometry.se3 import F8


@dataclass(frozen=True)
class Link:
    """An accepted loop: keyframe i of one drive sees keyframe j of another (or the same) again."""

    drive_i: int
    keyframe_i: int
    drive_j: int
    keyframe_j: int
    T_i_j: F8
    covariance: F8


def links(drives: Sequence[Drive], loops: Loops) -> list[Link]:
    """Accepted loops between sessions of this map.

    Raises
    ------
    StageError : a loop names a session or scan that is not there.
    """
    number: dict[str, list[int]] = {}
    for k, d in enumerate(drives):
        number.setdefault(d.name, []).append(k)
    found = []
    for row in np.flatnonzero(loops.accepted):
        ends = []
        for name, scan in (
            (loops.session_i[row], loops.scan_i[row]),
            (loops.session_j[row], loops.scan_j[row]),
        ):
            if name not in number:
                raise StageError(
                    f"a loop names session {name}, which is not part of this map",
                    next_step="run the loops stage again for these sessions",
                )
            at = _segment_of(drives, number[name], int(scan))
            ends.append((at, drives[at].keyframe_of_scan(int(scan))))
        (a, i), (b, j) = ends
        found.append(Link(a, i, b, j, loops.T_i_j[row], loops.covariance[row]))
    return found


def _segment_of(drives: Sequence[Drive], segments: Sequence[int], scan_index: int) -> int:
    """Which of the drives of a session holds a scan: the last that begins before it."""
    first = [int(drives[k].odometry.scan_index[0]) for k in segments]
    return segments[max(int(np.searchsorted(first, scan_index, side="right")) - 1, 0)]
