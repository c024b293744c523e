"""Loop closures: how many, which are true, and how many of the revisits were found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.evaluation.paths import TruePath
from scanloom.stages.evaluation.revisits import FOUND_WITHIN_M, LEFT_BEFORE_M, LEFT_BEFORE_S, Ends, Revisits
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.factor_rows import USED, loop_verdicts
from scanloom.stages.geometry.se3 import F8, inverse

Mask = NDArray[np.bool_]

REVISIT_M = 4.0
"""Scans this near to an earlier place ought to find it (methods 2.6)."""


@dataclass(frozen=True)
class Judgement:
    """Candidates (n,) that truth can judge, how far apart their places are in truth, and how wrong their poses."""

    known: Mask
    apart_m: F8
    error_m: F8
    error_rad: F8

    def right(self, max_error_m: float, max_error_deg: float) -> Mask:
        """Which (n,) have a true relative pose."""
        close = (self.error_m < max_error_m) & (np.degrees(self.error_rad) < max_error_deg)
        return np.asarray(self.known & close)


def judged(loops: Loops, paths: Mapping[str, TruePath]) -> Judgement:
    """Every candidate against truth, as far as truth covers both ends in one frame."""
    n = len(loops)
    known, out = np.zeros(n, bool), np.full((3, n), np.inf)
    for a, b in sorted(set(zip(loops.session_i, loops.session_j))):
        if a not in paths or b not in paths or paths[a].frame != paths[b].frame:
            continue
        rows = np.flatnonzero((loops.session_i == a) & (loops.session_j == b))
        row_i, known_i = paths[a].rows(loops.scan_i[rows])
        row_j, known_j = paths[b].rows(loops.scan_j[rows])
        both = known_i & known_j
        rows = rows[both]
        T_i_j = inverse(paths[a].T[row_i[both]]) @ paths[b].T[row_j[both]]
        known[rows] = True
        out[0, rows] = np.linalg.norm(T_i_j[:, :3, 3], axis=1)
        out[1:, rows] = alignment.motion_error(T_i_j, loops.T_i_j[rows])
    return Judgement(known, *out)


def loop_figures(
    loops: Loops, graph: Graph, judgement: Judgement, true: Mask, paths: Mapping[str, TruePath], back: Revisits
) -> Iterator[Figure]:  # fmt: skip
    """Counts of loops, and precision and recall where truth covers them.

    `true` (n,) are the candidates with a true relative pose. Loops between sessions are judged where the truths of both
    tell their place on the Earth.
    """
    used = np.asarray(loop_verdicts(loops, graph) == USED, bool)
    yield Figure("loops.candidates", len(loops), "", "pairs of places compared", "map")
    yield Figure(
        "loops.verified", int(loops.accepted.sum()), "", "pairs that passed the geometric tests", "map"
    )
    yield Figure("loops.accepted", int(used.sum()), "", "verified pairs that the pose graph uses", "map")
    between = used & (loops.session_i != loops.session_j)
    if len(set(loops.session_i) | set(loops.session_j)) > 1:
        yield Figure(
            "loops.between_sessions", int(between.sum()), "", "pairs in use that join two sessions", "map"
        )
    for name, what, rows in (
        ("loops.verified_precision", "verified", loops.accepted & judgement.known),
        ("loops.precision", "accepted", used & judgement.known),
    ):
        if rows.any():
            how = f"share of {int(rows.sum())} {what} loops within truth whose relative pose is true"
            yield Figure(name, float(true[rows].mean()), "", how, "map")
    positive = back.positive(REVISIT_M)
    places = int(positive.sum())
    if places:
        found = np.isfinite(back.first_found(loop_ends(loops, used & true, paths, np.zeros(len(loops)))))
        how = (
            f"share of {places} keyframes within {REVISIT_M:g} m of a place left {LEFT_BEFORE_M:g} m of path and "
            f"{LEFT_BEFORE_S:g} s before, or seen in an earlier session, with a true accepted loop within "
            f"{FOUND_WITHIN_M:g} m of path"
        )
        yield Figure("loops.recall", float(found[positive].mean()), "", how, "map")


def loop_ends(loops: Loops, rows: Mask, paths: Mapping[str, TruePath], value: F8) -> dict[str, Ends]:
    """Where the later ends of the chosen loops lie along the path of their session, with a value (n,) of each."""
    ends = {}
    for name, path in paths.items():
        own = np.flatnonzero(rows & (loops.session_j == name))
        row, known = path.rows(loops.scan_j[own])
        ends[name] = (path.travelled_m[row[known]], value[own[known]])
    return ends
