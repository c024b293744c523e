"""Where each drive starts in the map's frame: by its own GNSS, by loops to one that has a place, or by the segment before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scanloom.stages.fusion.bridging import Bridge
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.fusion.links import Link
from scanloom.stages.fusion.untied import Untied
from scanloom.stages.geometry.se3 import F8, inverse, se3_log

SAME_PLACE_M = 3.0
SAME_HEADING_RAD = np.radians(10.0)


def anchor(
    drives: Sequence[Drive], placed: Mapping[int, F8], found: Sequence[Link], gaps: Sequence[Bridge], *,
    anywhere: bool = True,
) -> dict[int, F8]:  # fmt: skip
    """Pose (4, 4) of every drive's frame `odom` in the map, spreading from the `placed` ones along loops.

    A segment that no loop reaches follows the one before it or after it by the bridge between them. `anywhere` says
    whether the placed ones have their place by more than being first.

    Raises
    ------
    Untied : a session has neither GNSS nor loops that tie it to the others.
    """
    start = dict(placed)
    while len(start) < len(drives):
        waiting = [d for d in range(len(drives)) if d not in start]
        by_loops = {d: p for d in waiting if (p := _proposals(drives, start, found, d))}
        by_bridges = {d: p for d in waiting if (p := _beyond(drives, start, gaps, d))}
        reached = by_loops or by_bridges
        if not reached:
            raise Untied.of([drives[d].name for d in waiting], anywhere=anywhere)
        d = min(reached)
        start[d] = _most_supported(reached[d])
    return start


def _beyond(drives: Sequence[Drive], start: Mapping[int, F8], gaps: Sequence[Bridge], d: int) -> list[F8]:
    """What the bridges to segments that have a place say about T_map_odom of drive `d`."""
    out = []
    for gap in gaps:
        a, b = gap.drive_i, gap.drive_i + 1
        T_a, T_b = _odom_pose(drives[a], -1), _odom_pose(drives[b], 0)
        if b == d and a in start:
            out.append(start[a] @ T_a @ gap.T_i_j @ inverse(T_b))
        elif a == d and b in start:
            out.append(start[b] @ T_b @ inverse(gap.T_i_j) @ inverse(T_a))
    return out


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
