"""Which scans come back to a place, by truth: what a search for loops ought to find."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.evaluation.paths import I8, TruePath
from scanloom.stages.geometry.se3 import F8

FARTHEST_M = 10.0
"""Places farther apart than this are never the same."""
LEFT_BEFORE_M, LEFT_BEFORE_S = 50.0, 30.0
"""So much path and time lies between two passes of one session."""
FOUND_WITHIN_M = 10.0
"""A scan counts as found when a right loop ends within this much path of it."""

QUERIES_AT_ONCE = 4096
"""Bounds the memory where a vehicle passes a place many times."""

Ends = tuple[F8, F8]
"""Where along the path of a session loops end (m,), m, and a value of each (m,)."""
NO_ENDS: Ends = (np.empty(0), np.empty(0))


@dataclass(frozen=True)
class Revisits:
    """Keyframes of all sessions with truth, each a query for places seen before (methods 2.6)."""

    session: NDArray[np.int64]
    """(n,) number of the session in `names`."""
    names: tuple[str, ...]
    travelled_m: F8
    """(n,) along the path of its session."""
    nearest_m: F8
    """(n,) distance to the nearest earlier place: of another session, or left long before; inf without any."""

    def first_found(self, ends: Mapping[str, Ends]) -> F8:
        """Smallest value (n,) of the loops that end within `FOUND_WITHIN_M` of path of each keyframe; inf without any."""
        first = np.full(len(self.session), np.inf)
        starts = np.searchsorted(self.session, np.arange(len(self.names) + 1))
        for number, name in enumerate(self.names):
            own = slice(starts[number], starts[number + 1])
            at, value = ends.get(name, NO_ENDS)
            low = starts[number] + np.searchsorted(self.travelled_m[own], at - FOUND_WITHIN_M)
            high = starts[number] + np.searchsorted(self.travelled_m[own], at + FOUND_WITHIN_M, side="right")
            for a, b, v in zip(low, high, value):
                first[a:b] = np.minimum(first[a:b], v)
        return first

    def positive(self, within_m: float) -> NDArray[np.bool_]:
        """Keyframes (n,) that come back to within `within_m` of a place."""
        return np.asarray(self.nearest_m <= within_m)


def revisits(paths: Mapping[str, TruePath]) -> Revisits:
    """Keyframes of all paths and how near each comes to an earlier place.

    Earlier means: of a session driven before, in the same frame of truth, or `LEFT_BEFORE_M` and `LEFT_BEFORE_S` before
    in its own.
    """
    names = tuple(sorted(paths))
    kept = [paths[name].keyframe for name in names]
    session = np.repeat(np.arange(len(names)), [int(mask.sum()) for mask in kept])
    travelled = _joined([paths[n].travelled_m[mask] for n, mask in zip(names, kept)], np.float64)
    stamp_ns = _joined([paths[n].stamp_ns[mask] for n, mask in zip(names, kept)], np.int64)
    position = _joined([paths[n].T[mask, :3, 3] for n, mask in zip(names, kept)], np.float64).reshape(-1, 3)
    frames = np.array([paths[n].frame for n in names], object)[session] if len(names) else np.empty(0, object)
    nearest = np.full(len(session), np.inf)
    for frame in sorted(set(frames)):
        rows = np.flatnonzero(frames == frame)
        nearest[rows] = _nearest_earlier(position[rows], session[rows], travelled[rows], stamp_ns[rows])
    return Revisits(session, names, travelled, nearest)


def _nearest_earlier(position: F8, session: I8, travelled: F8, stamp_ns: I8) -> F8:
    """Distance (n,) of each position to the nearest one that was left before."""
    from scipy.spatial import cKDTree

    tree = cKDTree(position)
    nearest = np.full(len(position), np.inf)
    for start in range(0, len(position), QUERIES_AT_ONCE):
        queries = cKDTree(position[start : start + QUERIES_AT_ONCE])
        near = queries.sparse_distance_matrix(tree, FARTHEST_M, output_type="ndarray")
        j, i = near["i"] + start, near["j"]
        later_s = (stamp_ns[j] - stamp_ns[i]) * 1e-9
        long_ago = (later_s >= LEFT_BEFORE_S) & (travelled[j] - travelled[i] >= LEFT_BEFORE_M)
        old = np.where(session[i] == session[j], long_ago, later_s > 0)
        np.minimum.at(nearest, j[old], near["v"][old])
    return nearest


def _joined(arrays: list[Any], dtype: type) -> Any:
    return np.concatenate(arrays) if arrays else np.empty(0, dtype)
