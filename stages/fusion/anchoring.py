"""Where each session starts in the map's frame: by its own GNSS, or by loops to a session that has a place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.geometry.se3 import F8, inverse, se3_log

SAME_PLACE_M = 3.0
SAME_HEADING_RAD = np.radians(10.0)


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
    number = {d.name: k for k, d in enumerate(drives)}
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
            ends.append((number[name], drives[number[name]].keyframe_of_scan(int(scan))))
        (a, i), (b, j) = ends
        found.append(Link(a, i, b, j, loops.T_i_j[row], loops.covariance[row]))
    return found


def anchor(drives: Sequence[Drive], placed: Mapping[int, F8], found: Sequence[Link]) -> dict[int, F8]:
    """Pose (4, 4) of every session's frame `odom` in the map, spreading from the `placed` ones along loops.

    Raises
    ------
    StageError : a session has neither GNSS nor loops that tie it to the others.
    """
    start = dict(placed)
    while len(start) < len(drives):
        reached = {d for d in range(len(drives)) if d not in start and _proposals(drives, start, found, d)}
        if not reached:
            lost = next(d for d in range(len(drives)) if d not in start)
            raise StageError(
                "nothing ties this session to the others: it has no usable GNSS and no loop to them was accepted",
                where=f"session {drives[lost].name}",
                next_step="map it on its own, or add a session that overlaps both",
            )
        d = min(reached)
        start[d] = _most_supported(_proposals(drives, start, found, d))
    return start


def _proposals(drives: Sequence[Drive], start: Mapping[int, F8], found: Sequence[Link], d: int) -> list[F8]:
    """What each loop between drive `d` and an anchored one says about T_map_odom of `d`."""
    out = []
    for link in found:
        T_a = _odom_pose(drives[link.drive_i], link.keyframe_i)
        T_b = _odom_pose(drives[link.drive_j], link.keyframe_j)
        if link.drive_j == d and link.drive_i in start:
            out.append(start[link.drive_i] @ T_a @ link.T_i_j @ inverse(T_b))
        elif link.drive_i == d and link.drive_j in start:
            out.append(start[link.drive_j] @ T_b @ inverse(link.T_i_j) @ inverse(T_a))
    return out


def _most_supported(proposals: Sequence[F8]) -> F8:
    """The proposal that most others lie near to; the first of equals."""
    T = np.array(proposals)
    error = np.abs(se3_log(inverse(T)[:, None] @ T[None]))
    near = (np.linalg.norm(error[..., :3], axis=-1) < SAME_HEADING_RAD) & (
        np.linalg.norm(error[..., 3:], axis=-1) < SAME_PLACE_M
    )
    return np.asarray(T[int(np.argmax(near.sum(axis=1)))])


def _odom_pose(drive: Drive, keyframe: int) -> F8:
    return np.asarray(drive.odometry.T_odom_lidar[drive.keyframes[keyframe]])
