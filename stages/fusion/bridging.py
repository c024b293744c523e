"""Between two segments of a session odometry knows nothing: what the vehicle's own sensors say, else a guess."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from scanloom.stages.fusion.drives import Drive, trusted
from scanloom.stages.fusion.gnss import Fixes
from scanloom.stages.fusion.links import Link
from scanloom.stages.fusion.wheel import Odometer
from scanloom.stages.geometry.se3 import F8, inverse


@dataclass(frozen=True)
class Bridge:
    """Motion (4, 4) from the last keyframe of drive `drive_i` to the first one of the next, covariance (6, 6)."""

    drive_i: int
    node_i: int
    node_j: int
    T_i_j: F8
    covariance: F8
    measured: bool
    """By gyro and wheels; else it is odometry's guess."""
    after_s: float
    """When it begins, since the start of the session, s."""


def bridges(drives: Sequence[Drive], odometers: Mapping[str, Odometer]) -> list[Bridge]:
    """One between each two neighbouring segments of a session."""
    found = []
    for number, (a, b) in enumerate(pairwise(drives)):
        if a.name != b.name:
            continue
        last, first = int(a.keyframes[-1]), int(b.keyframes[0])
        start, end = int(a.odometry.stamp_ns[last]), int(b.odometry.stamp_ns[first])
        told = odometers[a.name].motion(start, end) if a.name in odometers else None
        T, covariance = told or (
            inverse(a.odometry.T_odom_lidar[last]) @ b.odometry.T_odom_lidar[first],
            trusted(b.odometry.covariance[first][None])[0],
        )
        after_s = (start - a.session.start_ns) * 1e-9
        found.append(
            Bridge(number, int(a.nodes[-1]), int(b.nodes[0]), T, covariance, told is not None, after_s)
        )
    return found


def guessed(
    drives: Sequence[Drive], gaps: Sequence[Bridge], found: Sequence[Link], fixes: Sequence[Fixes]
) -> list[str]:
    """Sentences on segments that nothing but a guess holds to the rest of their session."""
    remarks = []
    for gap in gaps:
        a, b = gap.drive_i, gap.drive_i + 1
        linked = any(link.drive_i <= a < link.drive_j or link.drive_j <= a < link.drive_i for link in found)
        if not (gap.measured or linked or fixes[b].alignment is not None):
            remarks.append(
                f"session {drives[b].name}: odometry lost the motion {gap.after_s:.1f} s after the start, and neither "
                "loops nor GNSS nor wheels join the two parts; where the second lies to the first is a guess"
            )
    return remarks
