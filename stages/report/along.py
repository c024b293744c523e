"""What happened along the way of each session: errors, GNSS, directions that no scan saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.evaluation import ErrorTrack
from scanloom.schemas.session import Session
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.factor_rows import DOUBTED, FixRows, reason_counts
from scanloom.stages.geometry.unseen import KINDS, stretches, unseen, unseen_kinds
from scanloom.stages.report.plots import (
    F8,
    NOTHING,
    Plot,
    Trace,
    axis,
    bands,
    fixed,
    logarithmic,
    rows_of,
    short,
    thin,
    upwards,
)
from scanloom.stages.report.ways import DRIVEN, HOVER, Way, curve

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
DOT_COLOURS = {"used": "--good", "spare": "--quiet", "gate": "--curve-2", "off": "--bad"}
BLIND, NO_FIX = "--band", "--band-quiet"
_LEAST_RESIDUAL_M, _LEAST_E1_M = 0.001, 0.0001


def along(
    session: str, label: str, way: Way, data: list[Trace], y_axis: dict[str, Any], **layout: Any
) -> Plot:
    """A figure over the distance driven by one session."""
    x_axis = axis(DRIVEN, range=[0, round(way.length_m, 2) or 1.0], **layout.pop("x", {}))
    return Plot(label, data, {"xaxis": x_axis, "yaxis": y_axis, **layout}, "along", session)


def error_chart(session: str, track: ErrorTrack, way: Way) -> Plot:
    """Errors against truth of odometry and of the map."""
    if not len(track) or not len(way):
        return NOTHING
    rows = way.at_stamps(track.stamp_ns)
    odometry = "odometry, laid over truth at the first scan"
    data = [
        curve(odometry, way, rows, track.odometry_error_m, "--curve-2", "m"),
        curve("map, aligned to truth as a whole", way, rows, track.fusion_error_m, "--curve-1", "m"),
    ]
    both = np.concatenate((track.odometry_error_m, track.fusion_error_m))
    return along(session, "Distance to truth along the way", way, data, upwards("distance to truth, m", both))


@dataclass(frozen=True)
class VerdictCount:
    """How many fixes have one verdict, and the style of their dots."""

    text: str
    count: int
    kind: str


@dataclass(frozen=True)
class FixTrack:
    """GNSS of one session along its way: the figure, empty without a georeference, and the verdicts below it."""

    plot: Plot
    verdicts: list[VerdictCount]


def fix_track(session: str, fixes: FixRows, way: Way, georeferenced: bool) -> FixTrack:
    """Horizontal residual of every fix with a position over the distance driven, coloured by verdict."""
    kinds = np.array([dot_kind(str(text)) for text in fixes.verdict], object)
    kinds[~np.isfinite(fixes.horizontal_m)] = "none"
    counts = [
        VerdictCount(text, count, kind)
        for kind in DOTS
        for text, count in reason_counts(fixes.verdict[kinds == kind]).items()
    ]
    drawn = georeferenced and len(way) > 0 and bool(np.isfinite(fixes.horizontal_m).any())
    return FixTrack(_fix_chart(session, fixes, way, kinds) if drawn else NOTHING, counts)


def dot_kind(verdict: str) -> str:
    """Style of a fix by its verdict: in use, not needed, left out by a gate, switched off by the solver."""
    if verdict == "used":
        return "used"
    if verdict == SPARE:
        return "spare"
    return "off" if verdict.startswith(DOUBTED) else "gate"


def _fix_chart(session: str, fixes: FixRows, way: Way, kinds: NDArray[np.object_]) -> Plot:
    distance = fixes.horizontal_m
    row = way.at_scans(fixes.scan_index)
    data = []
    for kind, colour in DOT_COLOURS.items():
        chosen = np.flatnonzero(np.isfinite(distance) & (kinds == kind))
        if len(chosen):
            data.append(_dots(DOTS[kind], way, row[chosen], distance[chosen], colour))
    without = np.asarray(~np.isfinite(fixes.position_m).all(axis=1))
    missing = bands(_ranges(without, way.driven_m[row]), NO_FIX, way.length_m)
    y_axis = logarithmic("from fix to antenna, m", distance, _LEAST_RESIDUAL_M)
    return along(session, "Residuals of the GNSS fixes along the way", way, data, y_axis, shapes=missing)


def _dots(label: str, way: Way, rows: NDArray[np.int64], y: F8, colour: str) -> Trace:
    kept = thin(y, way.most)
    at = rows[kept]
    return {
        "type": "scatter", "mode": "markers", "name": label, "x": fixed(way.driven_m[at]),
        "y": short(np.maximum(y[kept], _LEAST_RESIDUAL_M)), "customdata": way.told(at), "meta": {"start_s": way.start_s},
        "marker": {"color": colour, "size": 5}, "hovertemplate": HOVER.replace("UNIT", "m"), "showlegend": True,
    }  # fmt: skip


@dataclass(frozen=True)
class Blindness:
    """Degeneracy of one session along its way, and how much of the way had an unseen direction."""

    plot: Plot
    share: float
    longest_m: float


def blindness(name: str, odometry: Odometry, session: Session, way: Way) -> Blindness:
    """E1 over the distance driven, with the stretches where a direction was unseen and which one it was."""
    if len(odometry) < 2:
        return Blindness(NOTHING, 0.0, 0.0)
    rows = way.at_scans(odometry.scan_index)
    driven = way.driven_m[rows]
    blind = unseen(odometry)
    ranges = _ranges(blind, driven)
    kinds = unseen_kinds(odometry, np.array(session.T_base("lidar"))[:3, :3])
    by_kind = [_ranges(kinds[:, k], driven) for k in range(len(KINDS))]
    longest = float((ranges[:, 1] - ranges[:, 0]).max(initial=0.0))
    return Blindness(_blind_chart(name, odometry, way, rows, ranges, by_kind), float(blind.mean()), longest)


def _blind_chart(
    name: str, odometry: Odometry, way: Way, rows: NDArray[np.int64], ranges: F8, by_kind: list[F8]
) -> Plot:
    e1_m = odometry.degeneracy_e[1:]
    if not np.isfinite(e1_m).any():
        return NOTHING
    data = [
        curve(
            "E1: expected error of the worst direction",
            way,
            rows[1:],
            np.maximum(e1_m, _LEAST_E1_M),
            "--curve-1",
            "m",
        )
    ]
    y_axis = logarithmic("E1, m", e1_m, _LEAST_E1_M)
    layout: dict[str, Any] = {"shapes": bands(ranges, BLIND, way.length_m)}
    if len(ranges):
        strips, below = rows_of(KINDS, by_kind, "--curve-2", way.length_m)
        data += strips
        y_axis["domain"] = [below["domain"][1] + 0.03, 1]
        layout |= {"yaxis2": below, "x": {"anchor": "y2"}}
    return along(name, "Expected error of the worst direction along the way", way, data, y_axis, **layout)


def blind_sessions(
    sessions: Mapping[str, Session], odometries: Mapping[str, Odometry], ways: Mapping[str, Way]
) -> dict[str, Blindness]:
    """`blindness` of every session with odometry."""
    return {
        name: blindness(name, odometries[name], sessions[name], ways[name])
        for name in sessions
        if name in ways and name in odometries
    }


def _ranges(marked: NDArray[np.bool_], way: F8) -> F8:
    """Stretches (k, 2) of the way that led to marked rows (n,)."""
    return way[np.array(stretches(marked), np.int64).reshape(-1, 2)]
