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
from scanloom.stages.report.plan import Plan
from scanloom.stages.report.raster import View

F8 = NDArray[np.float64]

_MAX_EDGES = 600
_MAX_REASONS = 8

USED_WITHIN, USED_BETWEEN, DOUBTED, REFUSED = "within", "between", "doubted", "refused"
EDGES = {
    REFUSED: "compared and refused",
    DOUBTED: "passed the tests, left out by the graph",
    USED_WITHIN: "in use",
    USED_BETWEEN: "in use, between sessions",
}
"""Kinds of edges in the order they are drawn, and what the legend says."""


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
class LoopGraph:
    """The drawing, its legend and the reasons; the drawing is empty without loops."""

    svg: str
    scale: str
    """How long the bar at the lower left is."""
    edges: list[EdgeCount]
    reasons: list[Reason]
    other_reasons: int
    """Pairs refused for reasons that the list has no room for."""

    @property
    def used(self) -> int:
        """Pairs in use."""
        return sum(edge.count for edge in self.edges if edge.kind in (USED_WITHIN, USED_BETWEEN))


def loop_graph(paths: Mapping[str, Poses], loops: Loops, graph: Graph) -> LoopGraph:
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
    ends = loop_ends(paths, loops)
    drawn = np.isfinite(ends).all(axis=(1, 2))
    if not drawn.any():
        return LoopGraph("", "", counts, reasons[:_MAX_REASONS], left)
    plan = Plan(paths)
    marks = "".join(_edges(plan.view, ends[drawn & (kinds == kind)], kind) for kind in EDGES)
    return LoopGraph(
        plan.draw(marks, "loop graph from above"), plan.scale, counts, reasons[:_MAX_REASONS], left
    )


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


def _edges(view: View, ends: F8, kind: str) -> str:
    """One path of all edges of a kind; a thinned choice of them when there are very many."""
    if not len(ends):
        return ""
    chosen = ends[:: -(-len(ends) // _MAX_EDGES)]
    pixels = view.pixels(chosen.reshape(-1, 2)).reshape(-1, 4)
    path = "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in pixels)
    dots = "".join(f"M{a:.1f} {b:.1f}h0M{c:.1f} {d:.1f}h0" for a, b, c, d in pixels)
    return (
        f'<path d="{path}" class="edge edge-{kind}"><title>{EDGES[kind]}</title></path>'
        f'<path d="{dots}" class="ends edge-{kind}"/>'
    )
