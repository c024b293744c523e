"""What happened along the way of each session: errors, GNSS, directions that no scan saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.evaluation import ErrorTrack
from scanloom.schemas.session import Session
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.geometry.alignment import travelled
from scanloom.stages.geometry.factor_rows import DOUBTED, FixRows, reason_counts
from scanloom.stages.geometry.unseen import KINDS, stretches, unseen, unseen_kinds
from scanloom.stages.report.charts import (
    F8,
    Bands,
    Curve,
    Dots,
    Layer,
    Strip,
    chart,
    exact,
    line_chart,
    logarithmic,
)

DRIVEN = "distance driven, m"
SPARE = "another fix of the same stretch is used"
"""Verdict of good fixes that are not needed."""
DOTS = {
    "spare": "good, but another fix of the same stretch is used",
    "used": "used",
    "gate": "left out by a test",
    "off": "switched off: contradicts the rest of the graph",
    "none": "no position to compare",
}
"""Styles of fixes in the order they are drawn, and what they mean."""
_LEAST_RESIDUAL_M, _LEAST_E1_M = 0.001, 0.001


def error_chart(track: ErrorTrack) -> str:
    """Errors against truth of odometry and of the map."""
    curves = [
        Curve("odometry, laid over truth at the first scan", track.travelled_m, track.odometry_error_m, 2),
        Curve("map, aligned as a whole", track.travelled_m, track.fusion_error_m, 1),
    ]
    return line_chart(curves, DRIVEN, "distance to truth, m")


@dataclass(frozen=True)
class VerdictCount:
    """How many fixes have one verdict, and the style of their dots."""

    text: str
    count: int
    kind: str


@dataclass(frozen=True)
class FixTrack:
    """GNSS of one session along its way: the drawing, empty without a georeference, and the verdicts below it."""

    chart: str
    verdicts: list[VerdictCount]


def fix_track(fixes: FixRows, poses: Poses) -> FixTrack:
    """Horizontal residual of every fix with a position over the distance driven, coloured by verdict."""
    kinds = np.array([dot_kind(str(text)) for text in fixes.verdict], object)
    kinds[~np.isfinite(fixes.horizontal_m)] = "none"
    counts = [
        VerdictCount(text, count, kind)
        for kind in DOTS
        for text, count in reason_counts(fixes.verdict[kinds == kind]).items()
    ]
    return FixTrack(_fix_chart(fixes, poses, kinds), counts)


def dot_kind(verdict: str) -> str:
    """Style of a fix by its verdict: in use, not needed, left out by a gate, switched off by the solver."""
    if verdict == "used":
        return "used"
    if verdict == SPARE:
        return "spare"
    return "off" if verdict.startswith(DOUBTED) else "gate"


def _fix_chart(fixes: FixRows, poses: Poses, kinds: np.ndarray) -> str:
    distance = fixes.horizontal_m
    seen = np.isfinite(distance)
    if poses.georeference is None or not seen.any():
        return ""
    way = travelled(poses.T_world_lidar)
    row = np.clip(np.searchsorted(poses.scan_index, fixes.scan_index), 0, len(poses) - 1)
    x = way[row]
    y_axis = logarithmic(_LEAST_RESIDUAL_M, float(distance[seen].max()))
    without = np.asarray(~np.isfinite(fixes.position_m).all(axis=1))
    layers: list[Layer] = [Bands("no position from the receiver", _ranges(without, x), "quiet")]
    for kind, label in DOTS.items():
        chosen = seen & (kinds == kind)
        if chosen.any():
            layers.append(Dots(label, x[chosen], distance[chosen], kind))
    return chart(layers, exact(float(way[-1])), y_axis, DRIVEN, "from fix to antenna, m")


@dataclass(frozen=True)
class Blindness:
    """Degeneracy of one session along its way, and how much of the way had an unseen direction."""

    chart: str
    share: float
    longest_m: float


def blindness(odometry: Odometry, session: Session) -> Blindness:
    """E1 over the distance driven, with the stretches where a direction was unseen and which one it was."""
    if len(odometry) < 2:
        return Blindness("", 0.0, 0.0)
    way = travelled(odometry.T_odom_lidar)
    blind = unseen(odometry)
    ranges = _ranges(blind, way)
    kinds = unseen_kinds(odometry, np.array(session.T_base("lidar"))[:3, :3])
    strips = [Strip(label, _ranges(kinds[:, k], way), "blind") for k, label in enumerate(KINDS)]
    drawn = _blind_chart(odometry.degeneracy_e[1:], way, ranges, strips)
    longest = float((ranges[:, 1] - ranges[:, 0]).max(initial=0.0))
    return Blindness(drawn, float(blind.mean()), longest)


def _blind_chart(e1_m: F8, way: F8, ranges: F8, strips: list[Strip]) -> str:
    known = np.isfinite(e1_m)
    if not known.any():
        return ""
    layers: list[Layer] = [
        Bands("a direction was not seen", ranges, "blind"),
        Curve("E1", way[1:][known], e1_m[known], 1),
    ]
    y_axis = logarithmic(_LEAST_E1_M, float(e1_m[known].max()))
    return chart(layers, exact(float(way[-1])), y_axis, DRIVEN, "E1, m", strips)


def blind_sessions(
    sessions: Mapping[str, Session], odometries: Mapping[str, Odometry]
) -> dict[str, Blindness]:
    """`blindness` of every session with odometry."""
    return {name: blindness(odometries[name], sessions[name]) for name in sessions if name in odometries}


def _ranges(marked: NDArray[np.bool_], way: F8) -> F8:
    """Stretches (k, 2) of the way that led to marked rows (n,)."""
    return way[np.array(stretches(marked), np.int64).reshape(-1, 2)]
