"""The loop graph from above: which places were joined, which were compared and refused, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry.factor_rows import USED, loop_verdicts, reason_counts
from scanloom.stages.report.figures import number
from scanloom.stages.report.plan import marks_plan
from scanloom.stages.report.plots import NOTHING, Plot, Trace, fixed, plain
from scanloom.stages.report.ways import Way

F8 = NDArray[np.float64]

_MAX_EDGES = 600
_MAX_REASONS = 8
_MAX_PAIRS = 60

USED_WITHIN, USED_BETWEEN, DOUBTED, REFUSED = "within", "between", "doubted", "refused"
EDGES = {
    REFUSED: "compared and refused",
    DOUBTED: "passed the tests, left out by the graph",
    USED_WITHIN: "in use",
    USED_BETWEEN: "in use, between sessions",
}
"""Kinds of edges in the order they are drawn, and what the legend says."""
COLOURS = {REFUSED: "--curve-2", DOUBTED: "--bad", USED_WITHIN: "--good", USED_BETWEEN: "--curve-3"}


@dataclass(frozen=True)
class EdgeCount:
    kind: str
    label: str
    count: int


@dataclass(frozen=True)
class Reason:
    """Why pairs were refused, by whom, and how many."""

    text: str
    by: str
    count: int


@dataclass(frozen=True)
class Pair:
    """One candidate: its scans, how well they fit, what became of it and why."""

    kind: str
    scans: str
    rmse: str
    overlap: str
    outcome: str


@dataclass(frozen=True)
class LoopGraph:
    """The figure, its legend and the reasons; the figure is empty without loops."""

    plot: Plot
    edges: list[EdgeCount]
    reasons: list[Reason]
    other_reasons: int
    """Pairs refused for reasons that the list has no room for."""
    pairs: list[Pair]
    """Those accepted first, as many as a list has room for."""

    @property
    def used(self) -> int:
        """Pairs in use."""
        return sum(edge.count for edge in self.edges if edge.kind in (USED_WITHIN, USED_BETWEEN))


def loop_graph(paths: Mapping[str, Poses], ways: Mapping[str, Way], loops: Loops, graph: Graph) -> LoopGraph:
    """Every candidate as an edge between its two places."""
    verdicts = loop_verdicts(loops, graph)
    kinds = edge_kinds(loops, verdicts)
    counts = [
        EdgeCount(kind, label, int((kinds == kind).sum()))
        for kind, label in EDGES.items()
        if (kinds == kind).any()
    ]
    reasons = _reasons(loops, verdicts, kinds)
    left = sum(reason.count for reason in reasons[_MAX_REASONS:])
    pairs = [_pair(loops, kinds, verdicts, k) for k in _listed(kinds)]
    plot = _drawn(paths, ways, loops, kinds)
    return LoopGraph(plot, counts, reasons[:_MAX_REASONS], left, pairs)


def edge_kinds(loops: Loops, verdicts: NDArray[np.object_]) -> NDArray[np.object_]:
    """What became of each candidate (n,): a key of `EDGES`."""
    kinds = np.full(len(loops), REFUSED, object)
    kinds[loops.accepted] = DOUBTED
    used = verdicts == USED
    kinds[used] = USED_WITHIN
    kinds[used & (loops.session_i != loops.session_j)] = USED_BETWEEN
    return kinds


def _reasons(loops: Loops, verdicts: NDArray[np.object_], kinds: NDArray[np.object_]) -> list[Reason]:
    found = [
        Reason(text, by, count)
        for by, texts in (
            ("tests", loops.reason[kinds == REFUSED]),
            ("graph", verdicts[kinds == DOUBTED]),
        )
        for text, count in reason_counts(texts).items()
    ]
    return sorted(found, key=lambda reason: -reason.count)


def loop_ends(paths: Mapping[str, Poses], loops: Loops) -> F8:
    """Both ends (n, 2, 2) of every candidate, m; NaN where a scan has no pose."""
    ends = np.full((len(loops), 2, 2), np.nan)
    for name, poses in paths.items():
        for side, (session, scan) in enumerate(
            ((loops.session_i, loops.scan_i), (loops.session_j, loops.scan_j))
        ):
            own = np.flatnonzero(session == name)
            if not len(own) or not len(poses):
                continue
            row = np.clip(np.searchsorted(poses.scan_index, scan[own]), 0, len(poses) - 1)
            known = poses.scan_index[row] == scan[own]
            ends[own[known], side] = poses.T_world_lidar[row[known], :2, 3]
    return ends


def _drawn(
    paths: Mapping[str, Poses], ways: Mapping[str, Way], loops: Loops, kinds: NDArray[np.object_]
) -> Plot:
    ends = loop_ends(paths, loops)
    known = np.isfinite(ends).all(axis=(1, 2))
    if not known.any():
        return NOTHING
    marks = []
    for kind in EDGES:
        rows = np.flatnonzero(known & (kinds == kind))
        marks += _edges(loops, ends, rows[:: max(-(-len(rows) // _MAX_EDGES), 1)], kind)
    return marks_plan("Loops from above", ways, marks)


def _edges(loops: Loops, ends: F8, rows: NDArray[np.int64], kind: str) -> list[Trace]:
    """Edges of a kind as one line with gaps and dots at its ends; a thinned choice of them when there are very many."""
    if not len(rows):
        return []
    gaps = np.full((len(rows), 1, 2), np.nan)
    xy = np.concatenate((ends[rows], gaps), axis=1).reshape(-1, 2)
    used = kind in (USED_WITHIN, USED_BETWEEN)
    shape = {
        "type": "scatter",
        "name": EDGES[kind],
        "x": fixed(xy[:, 0]),
        "y": fixed(xy[:, 1]),
        "legendgroup": kind,
    }
    told = [plain(_told(loops, k)) for k in rows for _ in range(3)]
    line = {"color": COLOURS[kind], "width": 1.8 if used else 1.0, "dash": "solid" if used else "dot"}
    dots = {"color": COLOURS[kind], "size": 6 if used else 4}
    return [
        {**shape, "mode": "lines", "line": line, "hoverinfo": "skip", "showlegend": True},
        {
            **shape,
            "mode": "markers",
            "marker": dots,
            "text": told,
            "hovertemplate": "%{text}<extra></extra>",
            "showlegend": False,
        },
    ]


def _told(loops: Loops, k: int) -> str:
    reason = "" if loops.accepted[k] else f": {loops.reason[k]}"
    return f"{_scans(loops, k)}, rmse {loops.rmse_m[k]:.2f} m, overlap {100 * loops.overlap[k]:.0f} %{reason}"


def _scans(loops: Loops, k: int) -> str:
    i, j = loops.session_i[k], loops.session_j[k]
    if i == j:
        return f"scans {loops.scan_i[k]} and {loops.scan_j[k]}"
    return f"{i} scan {loops.scan_i[k]} and {j} scan {loops.scan_j[k]}"


def _listed(kinds: NDArray[np.object_]) -> list[int]:
    order = [USED_BETWEEN, USED_WITHIN, DOUBTED, REFUSED]
    return [int(k) for kind in order for k in np.flatnonzero(kinds == kind)][:_MAX_PAIRS]


def _pair(loops: Loops, kinds: NDArray[np.object_], verdicts: NDArray[np.object_], k: int) -> Pair:
    outcome = {REFUSED: str(loops.reason[k]), DOUBTED: str(verdicts[k])}.get(kinds[k], "in use")
    rmse, overlap = number(float(loops.rmse_m[k])), number(round(100 * float(loops.overlap[k]), 1))
    return Pair(str(kinds[k]), _scans(loops, k), rmse, overlap, outcome)
