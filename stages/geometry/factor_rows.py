"""What the rows of the pose graph say of loops and of GNSS fixes."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]
Texts = NDArray[np.object_]

USED = "used"
DOUBTED = "switched off"
"""How verdicts begin of factors that the solver left out because the rest of the graph contradicts them."""
OUTSIDE = "outside the time of the scans"
"""Verdict of fixes that no pose can be held against."""


def split_key(key: str) -> tuple[str, int]:
    """Session and scan of a key `session/scan_index`."""
    session, _, scan = key.rpartition("/")
    return session, int(scan)


def loop_verdicts(loops: Loops, graph: Graph) -> Texts:
    """What the graph made of each candidate (n,): `used`, why it was left out, or empty when it made no factor."""
    rows = np.flatnonzero(graph.kind == "loop")
    found = {(graph.key_i[k], graph.key_j[k]): str(graph.verdict[k]) for k in rows}
    verdicts = np.full(len(loops), "", object)
    for k in np.flatnonzero(loops.accepted):
        key_i, key_j = f"{loops.session_i[k]}/{loops.scan_i[k]}", f"{loops.session_j[k]}/{loops.scan_j[k]}"
        verdicts[k] = found.get((key_i, key_j), "")
    return verdicts


@dataclass(frozen=True)
class FixRows:
    """The fixes of one session as the graph has them, in their own order."""

    scan_index: I8
    """(n,) keyframe that each was held against."""
    position_m: F8
    """(n, 3) in the map's frame; NaN without fix."""
    residual_m: F8
    """(n, 3) antenna minus fix; NaN without fix, or outside the time of the scans."""
    verdict: Texts

    def __len__(self) -> int:
        return len(self.scan_index)

    @property
    def used(self) -> NDArray[np.bool_]:
        return np.asarray(self.verdict == USED, bool)

    @property
    def horizontal_m(self) -> F8:
        """(n,) horizontal residual; NaN where there is none."""
        return np.asarray(np.hypot(self.residual_m[:, 0], self.residual_m[:, 1]))


def fix_rows(graph: Graph) -> dict[str, FixRows]:
    """Fixes of every session that has any."""
    keys: dict[str, list[tuple[int, int]]] = {}
    for row in np.flatnonzero(graph.kind == "gnss"):
        session, scan = split_key(graph.key_i[row])
        keys.setdefault(session, []).append((int(row), scan))
    return {session: _fixes(graph, np.array(pairs, np.int64)) for session, pairs in sorted(keys.items())}


def _fixes(graph: Graph, pairs: I8) -> FixRows:
    rows = pairs[:, 0]
    verdict = graph.verdict[rows]
    residual = np.where((verdict == OUTSIDE)[:, None], np.nan, graph.residual_m[rows])
    return FixRows(pairs[:, 1], graph.measurement[rows, :3, 3], residual, verdict)


def reason_counts(reasons: Texts) -> dict[str, int]:
    """How often each reason was given, the most frequent first; what differs in numbers only is counted together."""
    counts: dict[str, int] = {}
    for reason, count in Counter(reasons.tolist()).items():
        text = without_numbers(reason)
        counts[text] = counts.get(text, 0) + count
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def without_numbers(reason: str) -> str:
    """A reason with `…` for every number, so that `overlap 0.31 is small` and `overlap 0.28 is small` are one."""
    words = [_masked(word) for word in reason.split()]
    return " ".join(words)


def _masked(word: str) -> str:
    bare = word.strip("(),;:%")
    try:
        float(bare)
    except ValueError:
        return word
    return word.replace(bare, "…")
