"""Search for places by their looks: STV-SC's three stages (Tian et al. 2022; methods 2.5).

1. The nearest ring keys among places long enough ago, from kd-trees: also as seen from the lanes beside.
2. Scan context distance of these, sector keys aligned first.
3. Temporal verification: the places before and after must be alike, too, driven in the same or in the opposite direction.
   Where they are not, the segment scan context decides: what is left without ground and leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int
from scanloom.stages.loops.scan_context import (
    F4,
    I2,
    Contexts,
    best_distance,
    distance_around,
    heading_of,
    shifts_beside,
)

I8 = NDArray[np.int64]
B1 = NDArray[np.bool_]
RuledOut = Callable[[I8, I8], B1]


class SearchSettings(BaseModel):
    """STV-SC's parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    neighbours: int = Field(
        default=10, ge=1, le=1000, description="nearest ring keys that are compared in full, per lane, number"
    )
    rebuild_keyframes: int = Field(
        default=50,
        ge=1,
        le=100_000,
        description="a new search tree is built after so many keyframes; later ones are compared one by one, number",
    )
    max_distance: float = Field(
        default=0.45,
        gt=0,
        le=1,
        description="tau: less alike places are no candidates, scan context distance",
    )
    shift_share: float = Field(
        default=0.05,
        ge=0,
        le=1,
        description="column shifts tested on either side of where sector keys align, share of the turn",
    )
    alignments: int = Field(
        default=3,
        ge=1,
        le=60,
        description="alignments of the sector keys around which they are tested, the best first, number",
    )
    temporal_frames: int = Field(
        default=2, ge=0, le=20, description="N_t: places before and after that must be alike, too, number"
    )
    temporal_step_m: float = Field(default=2.0, gt=0, le=50, description="way between these, m")
    temporal_margin: float = Field(
        default=0.05,
        ge=0,
        le=1,
        description="the places before and after may be less alike by this, scan context distance",
    )
    max_segment_distance: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="re-identification: segments at most this different outweigh neighbours that are, segment scan context distance",
    )


@dataclass(frozen=True)
class Looks:
    """Keyframes of one track: descriptors of all that stands there and of segments, and the way driven."""

    context: Contexts
    """(lanes, n, ...): as seen from the LiDAR, from the lane to its left, from that to its right."""
    segment: Contexts
    path_m: F8

    def __len__(self) -> int:
        return len(self.path_m)

    @property
    def lanes(self) -> int:
        return len(self.context.column)


@dataclass(frozen=True)
class Matches:
    """The most alike earlier place of each query (n,)."""

    place: I8
    """-1 where there is none."""
    shift: I8
    distance: F8
    temporal: F8
    segment: F8
    """NaN where it was not asked."""
    score: F8
    """The smallest tau at which the three stages let the match pass; inf where there is none."""

    def heading(self, k: int) -> float:
        """Heading of query k in its match, rad."""
        return heading_of(int(self.shift[k]))

    def source(self, k: int) -> Literal["temporal", "segments"]:
        """What speaks for match k besides its own looks."""
        return "segments" if np.isfinite(self.segment[k]) else "temporal"


def search(
    settings: SearchSettings,
    old: Looks,
    new: Looks,
    queries: I8,
    admitted: I8,
    ruled_out: RuledOut | None = None,
) -> Matches:
    """For each of the keyframes `queries` (n,) of `new`, the best of the first `admitted` (n,) keyframes of `old`.

    `ruled_out` says of pairs (i, j), any shape, which cannot be one place whatever they look like.
    """
    forest = Forest(old.context.ring_key[0], settings.rebuild_keyframes)
    keys = new.context.ring_key[:, queries]
    near = [forest.nearest(of_lane, admitted, settings.neighbours) for of_lane in keys]
    candidates = np.ascontiguousarray(np.concatenate(near, axis=1))
    lane = np.repeat(np.arange(new.lanes), settings.neighbours)
    impossible = candidates < 0
    if ruled_out is not None:
        impossible |= ruled_out(
            np.maximum(candidates, 0), np.broadcast_to(queries[:, None], candidates.shape)
        )
    out = _Out(len(queries))
    steps: F8 = settings.temporal_step_m * np.arange(1, settings.temporal_frames + 1, dtype=float)
    _three_stages(
        old.context.column[0], old.context.sector_key[0], old.segment.column[0], new.context.column,
        new.context.sector_key, new.segment.column, queries, candidates, lane, _around(old.path_m, steps),
        _around(new.path_m, steps), shifts_beside(settings.shift_share), settings.alignments,
        impossible, settings.temporal_margin, settings.max_segment_distance, out.place,
        out.shift, out.numbers,
    )  # fmt: skip
    distance, temporal, segment, score = np.ascontiguousarray(out.numbers.T)
    return Matches(out.place, out.shift, distance, temporal, segment, score)


class _Out:
    """What the kernel fills: distance, temporal and segment distance, score."""

    def __init__(self, count: int) -> None:
        self.place, self.shift = np.full(count, -1, np.int64), np.zeros(count, np.int64)
        self.numbers = np.tile([1.0, np.nan, np.nan, np.inf], (count, 1))


def _around(path_m: F8, steps_m: F8) -> I8:
    """Keyframes (n, 2 m) nearest to `steps_m` (m,) before, then after each; -1 where the track does not reach so far."""
    if not len(path_m):
        return np.empty((0, 2 * len(steps_m)), np.int64)
    wanted = path_m[:, None] + np.concatenate((-steps_m, steps_m))
    after = np.clip(np.searchsorted(path_m, wanted), 1, max(len(path_m) - 1, 1))
    after = np.minimum(after, len(path_m) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.where(wanted - path_m[before] <= path_m[after] - wanted, before, after)
    reached = (wanted >= path_m[0] - 1e-6) & (wanted <= path_m[-1] + 1e-6)
    return np.ascontiguousarray(np.where(reached, nearer, -1), np.int64)


# ------------------------------------------------------------------------------------------------------- ring-key trees


class Forest:
    """The nearest of the first m ring keys, for any m, in time that grows with the logarithm of m.

    A tree stands over each aligned run of `period` 2^k keys and is built when it is first asked for. The first m keys
    are a few such runs and less than `period` keys more, which are compared one by one.
    """

    def __init__(self, keys: F4, period: int) -> None:
        self._keys = np.asarray(keys, float)
        self._period = period
        self._trees: dict[tuple[int, int], Any] = {}

    def nearest(self, queries: F4, first: I8, count: int) -> I8:
        """Numbers (n, count) of the keys nearest to `queries` (n, d) among the `first` (n,), nearest first; -1 for want of."""
        asked = np.asarray(queries, float)
        found = np.full((len(asked), count), -1, np.int64)
        distance = np.full((len(asked), count), np.inf)
        runs: dict[tuple[int, int], list[int]] = {}
        for q, m in enumerate(first):
            whole = int(m) // self._period
            for run in _runs(whole):
                runs.setdefault(run, []).append(q)
            rest = np.arange(whole * self._period, int(m))
            self._merge(found, distance, np.array([q]), rest[None], self._compared(asked[q], rest)[None])
        for run, members in sorted(runs.items()):
            rows = np.array(members)
            self._merge(found, distance, rows, *self._in_tree(run, asked[rows], count))
        return found

    def _compared(self, query: F8, rows: I8) -> F8:
        return np.asarray(np.linalg.norm(self._keys[rows] - query, axis=1))

    def _in_tree(self, run: tuple[int, int], queries: F8, count: int) -> tuple[I8, F8]:
        from scipy.spatial import cKDTree

        start, length = run[0] * self._period, run[1] * self._period
        if run not in self._trees:
            self._trees[run] = cKDTree(self._keys[start : start + length])
        k = min(count, length)
        distance, row = self._trees[run].query(queries, k=range(1, k + 1))
        return row + start, distance

    @staticmethod
    def _merge(found: I8, distance: F8, rows: I8, more: I8, more_distance: F8) -> None:
        """The best of what was found and what comes, of equals the older."""
        numbers = np.concatenate((found[rows], more), axis=1)
        lengths = np.concatenate((distance[rows], more_distance), axis=1)
        order = np.lexsort((numbers, lengths))[:, : found.shape[1]]
        found[rows] = np.take_along_axis(numbers, order, axis=1)
        distance[rows] = np.take_along_axis(lengths, order, axis=1)


def _runs(count: int) -> Sequence[tuple[int, int]]:
    """Aligned runs (start, length) whose lengths are powers of two that make up the first `count`."""
    runs, start = [], 0
    for bit in reversed(range(count.bit_length())):
        if count & (1 << bit):
            runs.append((start, 1 << bit))
            start += 1 << bit
    return runs


# -------------------------------------------------------------------------------------------------------- three stages


@kernel
def _three_stages(
    old: I2, old_key: F4, old_segment: I2, new: I2, new_key: F4, new_segment: I2, queries: I8, candidates: I8, lane: I8,
    around_old: I8, around_new: I8, beside: int, alignments: int, impossible: B1, margin: float, most: float, place: I8, shift: I8, numbers: F8,
) -> None:  # fmt: skip
    """`new*` have lanes first. The match of the smallest score, d, or max(d, t - margin) where segments do not outweigh t."""
    count = candidates.shape[1]
    d, s = np.empty(count), np.empty(count, np.int64)
    for q in range(len(queries)):
        j = queries[q]
        for k in range(count):
            i = candidates[q, k]
            d[k], s[k] = 2.0, 0
            if not impossible[q, k]:
                d[k], s[k] = best_distance(
                    old[i], new[lane[k], j], old_key[i], new_key[lane[k], j], beside, alignments
                )
        for k in np.argsort(d, kind="mergesort"):
            i = candidates[q, k]
            if d[k] >= min(numbers[q, 3], 1.0):
                break
            t = _temporal(old, new[lane[k]], around_old[i], around_new[j], s[k], beside)
            score, segment = d[k], np.nan
            if t - margin > d[k]:
                segment = distance_around(old_segment[i], new_segment[lane[k], j], s[k], beside)[0]
                if not segment <= most:
                    score = t - margin
            if score < numbers[q, 3]:
                place[q], shift[q] = i, s[k]
                numbers[q, 0], numbers[q, 1], numbers[q, 2], numbers[q, 3] = d[k], t, segment, score


@kernel
def _temporal(old: I2, new: I2, around_old: I8, around_new: I8, shift: Int, beside: int) -> float:
    """Mean distance of the places around, at the same turn, driven in the same or in the opposite direction; 1 for none."""
    count = len(around_old)
    best = 1.0
    for reverse in range(2):
        total, known = 0.0, 0
        for n in range(count):
            i, j = around_old[(n + count // 2) % count if reverse else n], around_new[n]
            if i >= 0 and j >= 0:
                total += distance_around(old[i], new[j], shift, beside)[0]
                known += 1
        if known > 0:
            best = min(best, total / known)
    return best
