"""Search by looks alone, without any geometric check: scan context against STV-SC, on revisits of either direction.

Protocol (methods 2.6): every keyframe asks once and gets one answer, the best among the keyframes left at least 50 m of
path and 30 s before. It is positive when one of these is truly within 4 m (also 3, 5, 10 m), and the answer is true within
the same. A revisit is `opposite` when all keyframes that near were driven the other way, else `same`. The curve of a
direction is over its revisits and over all keyframes that revisit nothing: what they are answered is false.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.places_worlds import World
from benchmarks.scores import Figure
from scanloom.stages.evaluation.precision import Curve, curve
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.loops.candidates import CandidateSettings, Track, admitted_before
from scanloom.stages.loops.position import PositionSettings
from scanloom.stages.loops.scan_context import Contexts
from scanloom.stages.loops.search import Looks, Matches, SearchSettings, search

RADII_M = (4.0, 3.0, 5.0, 10.0)
"""Of what counts as the same place; the first is the one that figures without a radius in their name mean."""
DIRECTIONS = ("opposite", "same", "all")
B1 = NDArray[np.bool_]


@dataclass(frozen=True)
class Method:
    """One way of searching: settings, how many views of a place it uses, and whether odometry has a say."""

    name: str
    what: str
    settings: SearchSettings
    lanes: int
    odometry: bool = False


PLAIN = SearchSettings(temporal_margin=1.0, alignments=1)
"""No neighbour exceeds this margin: neither temporal verification nor segments."""
METHODS = (
    Method("scan_context", "scan context as published", PLAIN, 1),
    Method("scan_context_lanes", "scan context, also from the lanes beside", PLAIN, 3),
    Method("stv_sc_own_lane", "STV-SC as published, from the LiDAR alone", SearchSettings(alignments=1), 1),
    Method("stv_sc", "STV-SC, also from the lanes beside", SearchSettings(), 3),
    Method(
        "stv_sc_odometry",
        "the same without what odometry rules out, as in the product",
        SearchSettings(),
        3,
        True,
    ),
)


@dataclass(frozen=True)
class Revisits:
    """What truth says of each keyframe (n,): whether it is back within a radius, and which way it came."""

    same: B1
    opposite: B1

    def of(self, direction: str) -> tuple[B1, B1]:
        """Positive queries of a direction, and the queries that its curve is about."""
        back = self.same | self.opposite
        positive = {"same": self.same, "opposite": self.opposite, "all": back}[direction]
        return positive, positive | ~back


def admitted(track: Track) -> NDArray[np.int64]:
    """How many of the first keyframes each keyframe may match."""
    limits = CandidateSettings()
    every = np.arange(len(track))
    return admitted_before(track.travelled_m, track.stamp_ns, every, limits.min_path_m, limits.min_time_s)


def revisits(T_true: F8, admitted: NDArray[np.int64], radius_m: float) -> Revisits:
    """Which keyframes have an admitted one within the radius, and whether only ones driven the other way."""
    same, opposite = np.zeros(len(T_true), bool), np.zeros(len(T_true), bool)
    forward = T_true[:, :3, 0]
    for j, m in enumerate(admitted):
        near = np.linalg.norm(T_true[:m, :3, 3] - T_true[j, :3, 3], axis=1) < radius_m
        along = forward[:m][near] @ forward[j]
        same[j], opposite[j] = bool((along > 0).any()), bool(len(along) and (along <= 0).all())
    return Revisits(same, opposite)


def answers(method: Method, track: Track, admitted: NDArray[np.int64]) -> tuple[Matches, float]:
    """The match of every keyframe, and the time it took, s of computing."""
    looks = of_lanes(track.looks, method.lanes)
    every = np.arange(len(track))
    rules = partial(track.whereabouts.ruled_out, PositionSettings()) if method.odometry else None
    search(method.settings, looks, looks, every[-2:], admitted[-2:], rules)  # compiles
    started = time.process_time()
    found = search(method.settings, looks, looks, every, admitted, rules)
    return found, time.process_time() - started


def of_lanes(looks: Looks, lanes: int) -> Looks:
    """The first views of every place alone."""

    def first(c: Contexts) -> Contexts:
        return Contexts(c.column[:lanes], c.sector_key[:lanes], c.ring_key[:lanes])

    return Looks(first(looks.context), first(looks.segment), looks.path_m)


@dataclass(frozen=True)
class Answered:
    """What a method said of a world, judged at one radius."""

    score: F8
    right: B1
    revisits: Revisits

    def curve(self, direction: str) -> Curve:
        positive, asked = self.revisits.of(direction)
        return curve(self.score[asked], self.right[asked], positive[asked])


def judged(found: Matches, T_true: F8, admitted: NDArray[np.int64], radius_m: float) -> Answered:
    """Answers against truth."""
    p = T_true[:, :3, 3]
    near = np.linalg.norm(p[np.maximum(found.place, 0)] - p, axis=1) < radius_m
    return Answered(found.score, near & (found.place >= 0), revisits(T_true, admitted, radius_m))


def pooled(parts: Sequence[Answered]) -> Answered:
    """Several worlds as one: one threshold for all."""
    both = Revisits(
        np.concatenate([a.revisits.same for a in parts]), np.concatenate([a.revisits.opposite for a in parts])
    )
    return Answered(np.concatenate([a.score for a in parts]), np.concatenate([a.right for a in parts]), both)


def figures(kind: str, worlds: Sequence[World]) -> Iterator[Figure]:
    """Of each method: curves over all worlds of a kind together, and of each world what counts most."""
    for method in METHODS:
        answered = [(w, a, *answers(method, w.track, a)) for w, a in ((w, admitted(w.track)) for w in worlds)]
        for radius in RADII_M:
            parts = [judged(found, w.T_true, a, radius) for w, a, found, _ in answered]
            suffix = "" if radius == RADII_M[0] else f".within_{radius:g}m"
            for direction in DIRECTIONS:
                name = f"loops.{kind}.{method.name}.{direction}{suffix}"
                yield from _summary(name, kind, method, pooled(parts), direction, radius)
            if radius == RADII_M[0] and len(worlds) > 1:
                for w, part in zip(worlds, parts, strict=True):
                    yield from _of_world(f"loops.{w.name}.{method.name}", w.name, method, part)
        queries = sum(len(w.track) for w in worlds)
        ms = 1e3 * sum(seconds for *_, seconds in answered) / queries
        how = f"computing per keyframe, {queries} of them, one core"
        yield Figure(f"loops.{kind}.{method.name}.search_ms", ms, "ms", kind, how)


def _summary(
    name: str, kind: str, method: Method, part: Answered, direction: str, radius: float
) -> Iterator[Figure]:
    positive = int(part.revisits.of(direction)[0].sum())
    if not positive:
        return
    line = part.curve(direction)
    how = f"{method.what}; {positive} revisits within {radius:g} m, {direction}, no geometric check"
    for label, value in (
        ("recall_at_p1", line.recall_at(1.0)),
        ("recall_at_p0.9", line.recall_at(0.9)),
        ("f1_max", line.f1_max()),
        ("extended_precision", line.extended_precision()),
    ):
        yield Figure(f"{name}.{label}", value, "", kind, how)


def _of_world(name: str, scope: str, method: Method, part: Answered) -> Iterator[Figure]:
    for direction in DIRECTIONS[:2]:
        positive = int(part.revisits.of(direction)[0].sum())
        if positive:
            how = f"{method.what}; {positive} revisits"
            value = part.curve(direction).recall_at(0.9)
            yield Figure(f"{name}.{direction}.recall_at_p0.9", value, "", scope, how)
