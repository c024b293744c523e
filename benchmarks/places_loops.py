"""What became of loops in the product: how many of those accepted are true, and how many revisits have one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.places_search import DIRECTIONS, RADII_M, admitted, revisits
from benchmarks.places_worlds import World
from benchmarks.scores import Figure
from scanloom.stages.evaluation.loops import judged
from scanloom.stages.evaluation.paths import true_paths
from scanloom.stages.evaluation.revisits import FOUND_WITHIN_M
from scanloom.stages.geometry.se3 import F8

TRUE_M, TRUE_DEG = 0.5, 2.0
B1 = NDArray[np.bool_]


def figures(kind: str, worlds: Sequence[World]) -> Iterator[Figure]:
    """Precision of accepted loops and recall of revisited keyframes, over all worlds of a kind and of each."""
    for name, chosen in [(kind, worlds), *((w.name, [w]) for w in worlds if len(worlds) > 1)]:
        yield from _figures(name, chosen)


def _figures(name: str, worlds: Sequence[World]) -> Iterator[Figure]:
    right = [true_loops(w) for w in worlds]
    accepted = sum(int(w.loops.accepted.sum()) for w in worlds)
    true = sum(int(r.sum()) for r in right)
    yield Figure(
        f"loops.{name}.candidates", sum(len(w.loops) for w in worlds), "", name, "pairs of places verified"
    )
    yield Figure(f"loops.{name}.accepted", accepted, "", name, "passed every geometric test")
    yield Figure(f"loops.{name}.wrong", accepted - true, "", name, "accepted, but not true")
    how = f"share of {accepted} accepted loops within {TRUE_M:g} m and {TRUE_DEG:g} deg of truth"
    if accepted:
        yield Figure(f"loops.{name}.precision", true / accepted, "", name, how)
    for direction in DIRECTIONS:
        found, positive = np.sum([_recalled(w, r, direction) for w, r in zip(worlds, right)], axis=0)
        if positive:
            how = (
                f"share of {positive} keyframes within {RADII_M[0]:g} m of an earlier place ({direction} direction) "
                f"with a true accepted loop within {FOUND_WITHIN_M:g} m of path"
            )
            suffix = "" if direction == "all" else f".{direction}"
            yield Figure(f"loops.{name}.recall{suffix}", found / positive, "", name, how)


def true_loops(w: World) -> B1:
    """Which loops (n,) are accepted and true."""
    paths = true_paths({w.track.name: w.truth}, {w.track.name: w.odometry})
    return np.asarray(w.loops.accepted & judged(w.loops, paths).right(TRUE_M, TRUE_DEG))


def _recalled(w: World, right: B1, direction: str) -> tuple[int, int]:
    """How many revisits have a true loop near, and how many there are."""
    back = revisits(w.T_true, admitted(w.track), RADII_M[0]).of(direction)[0]
    travelled: F8 = w.track.travelled_m
    ends = travelled[np.searchsorted(w.track.scan_index, w.loops.scan_j[right])]
    if not len(ends):
        return 0, int(back.sum())
    near = np.abs(travelled[:, None] - ends).min(axis=1) <= FOUND_WITHIN_M
    return int((near & back).sum()), int(back.sum())
