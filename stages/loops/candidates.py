"""Loop candidates: keyframes that may show the same place, by their looks and by odometry's position."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Places
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.loops.position import PositionSettings, Whereabouts, accumulated
from scanloom.stages.loops.scan_context import F4, contexts
from scanloom.stages.loops.search import Looks, SearchSettings, search

I8 = NDArray[np.int64]
Source = Literal["position", "temporal", "segments"]

LEAST_CANDIDATES = 20


class CandidateSettings(BaseModel):
    """Where loops are looked for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_path_m: float = Field(
        default=50.0, gt=0, le=1e4, description="path between two passes of one session, at least, m"
    )
    min_time_s: float = Field(
        default=30.0, ge=0, le=1e4, description="time between two passes of one session, at least, s"
    )
    query_spacing_m: float = Field(default=2.0, gt=0, le=100, description="one search per this much path, m")
    search: SearchSettings = Field(default_factory=SearchSettings, description="search by looks")
    position: PositionSettings = Field(
        default_factory=PositionSettings, description="search by odometry's position"
    )
    spacing_m: float = Field(
        default=10.0, gt=0, le=1000, description="no two candidates are closer than this on both passes, m"
    )
    per_km: float = Field(
        default=100.0,
        gt=0,
        le=1e4,
        description="candidates verified per kilometre driven, the best first, at least 20",
    )


@dataclass(frozen=True)
class Track:
    """Keyframes of one session with their descriptors; of one segment, where odometry lost the motion in between.

    Segments are to each other as sessions are: odometry predicts nothing between them.
    """

    name: str
    scan_index: I8
    stamp_ns: I8
    T_odom_lidar: F8
    travelled_m: F8
    whereabouts: Whereabouts
    looks: Looks

    def __len__(self) -> int:
        return len(self.scan_index)


@dataclass(frozen=True)
class Candidate:
    """Keyframe `i` of track `a` (the earlier) and keyframe `j` of track `b`."""

    a: int
    i: int
    b: int
    j: int
    descriptor_distance: float
    """NaN when odometry's position proposed it."""
    yaw_rad: float
    """Heading of j in i by the descriptors; NaN when they do not tell."""
    predicted: F8 | None
    """T_i_j by odometry; None between sessions."""
    score: float
    """Smaller is more promising."""
    source: Source = "position"
    temporal_distance: float = float("nan")
    segment_distance: float = float("nan")
    """NaN where it was not asked."""


def tracks_of(name: str, odometry: Odometry, places: Places) -> list[Track]:
    """Keyframes that have both a pose and a descriptor, segment by segment.

    Raises
    ------
    StageError : a place is no scan of the odometry.
    """
    row = {int(s): k for k, s in enumerate(odometry.scan_index)}
    missing = [int(s) for s in places.scan_index if int(s) not in row]
    if missing:
        raise StageError(
            f"place of scan {missing[0]} has no odometry",
            where=f"session {name}",
            next_step="run places again",
        )
    rows = np.array([row[int(s)] for s in places.scan_index], np.int64)
    step = np.linalg.norm(np.diff(odometry.T_odom_lidar[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate(([0.0], np.cumsum(step)))[: len(odometry)]
    spread = accumulated(odometry)
    parts = [np.flatnonzero(odometry.segment[rows] == s) for s in np.unique(odometry.segment[rows])]
    return [
        Track(
            name,
            places.scan_index[part],
            odometry.stamp_ns[rows[part]],
            odometry.T_odom_lidar[rows[part]],
            travelled[rows[part]],
            Whereabouts(odometry.T_odom_lidar[rows[part], :3, 3], spread[rows[part]], travelled[rows[part]]),
            looks_of(places, part, travelled[rows[part]]),
        )
        for part in parts or [np.zeros(0, np.int64)]
    ]


def looks_of(places: Places, rows: I8, travelled_m: F8) -> Looks:
    """What the places (n,) in `rows` look like, ready to be compared; `travelled_m` (n,) is the way up to each."""
    context = _views(places.descriptor[rows], places.beside[rows])
    segment = _views(places.segment_descriptor[rows], places.segment_beside[rows])
    return Looks(contexts(context), contexts(segment), np.ascontiguousarray(travelled_m))


def _views(straight: F4, beside: F4) -> F4:
    """(3, n, 20, 60) of (n, 20, 60) and (n, 2, 20, 60)."""
    return np.concatenate((straight[None], np.swapaxes(beside, 0, 1)))


def candidates(settings: CandidateSettings, tracks: Sequence[Track]) -> list[Candidate]:
    """The most promising candidates of all sessions, thinned along the tracks, best first."""
    found = [*_by_position(settings, tracks), *_by_looks(settings, tracks)]
    found.sort(key=lambda c: (c.score, c.b, c.j, c.a, c.i))
    driven_m = sum(float(t.travelled_m[-1] - t.travelled_m[0]) for t in tracks if len(t))
    most = max(LEAST_CANDIDATES, int(settings.per_km * driven_m / 1000.0))
    kept: list[Candidate] = []
    taken: dict[tuple[int, int, int, int], list[tuple[float, float]]] = {}
    for c in found:
        if len(kept) == most:
            break
        s_i, s_j = float(tracks[c.a].travelled_m[c.i]), float(tracks[c.b].travelled_m[c.j])
        if not _crowded(taken, c, s_i, s_j, settings.spacing_m):
            kept.append(c)
            cell = (c.a, c.b, int(s_i // settings.spacing_m), int(s_j // settings.spacing_m))
            taken.setdefault(cell, []).append((s_i, s_j))
    return kept


def _crowded(
    taken: dict[tuple[int, int, int, int], list[tuple[float, float]]], c: Candidate, s_i: float, s_j: float, spacing: float
) -> bool:  # fmt: skip
    u, v = int(s_i // spacing), int(s_j // spacing)
    for du in (-1, 0, 1):
        for dv in (-1, 0, 1):
            for p, q in taken.get((c.a, c.b, u + du, v + dv), ()):
                if abs(p - s_i) < spacing and abs(q - s_j) < spacing:
                    return True
    return False


def queries_of(travelled_m: F8, spacing_m: float) -> I8:
    """The first keyframe of every stretch of path."""
    return np.unique(np.floor(travelled_m / spacing_m), return_index=True)[1].astype(np.int64)


def admitted_before(travelled_m: F8, stamp_ns: I8, queries: I8, min_path_m: float, min_time_s: float) -> I8:
    """How many of the first keyframes were left long enough before each of the keyframes `queries`."""
    by_path = np.searchsorted(travelled_m, travelled_m[queries] - min_path_m, side="right")
    by_time = np.searchsorted(stamp_ns, stamp_ns[queries] - int(min_time_s * 1e9), side="right")
    return np.minimum(by_path, by_time).astype(np.int64)


def _asked(settings: CandidateSettings, track: Track) -> tuple[I8, I8]:
    """Keyframes of a track that are searched for, and how many of its first each may match."""
    queries = queries_of(track.travelled_m, settings.query_spacing_m)
    return queries, admitted_before(
        track.travelled_m, track.stamp_ns, queries, settings.min_path_m, settings.min_time_s
    )


def _by_position(settings: CandidateSettings, tracks: Sequence[Track]) -> Iterator[Candidate]:
    """For each search position, the nearest earlier keyframe of the same track."""
    for number, track in enumerate(tracks):
        queries, admitted = _asked(settings, track)
        place, share = track.whereabouts.nearest_earlier(settings.position, queries, admitted)
        for k in np.flatnonzero(place >= 0):
            i, j = int(place[k]), int(queries[k])
            predicted = inverse(track.T_odom_lidar[i]) @ track.T_odom_lidar[j]
            yield Candidate(number, i, number, j, float("nan"), float("nan"), predicted, float(share[k]))


def _by_looks(settings: CandidateSettings, tracks: Sequence[Track]) -> Iterator[Candidate]:
    """For each search position, the most alike earlier keyframe of each track."""
    for b, track in enumerate(tracks):
        queries, admitted = _asked(settings, track)
        for a in range(b + 1):
            whole = np.full(len(queries), len(tracks[a]), np.int64)
            found = search(
                settings.search, tracks[a].looks, track.looks, queries, admitted if a == b else whole,
                partial(track.whereabouts.ruled_out, settings.position) if a == b else None,
            )  # fmt: skip
            for k in np.flatnonzero(found.score <= settings.search.max_distance):
                i, j, yaw = int(found.place[k]), int(queries[k]), found.heading(int(k))
                first, second = (a, i), (b, j)
                if tracks[a].stamp_ns[i] > track.stamp_ns[j]:
                    first, second, yaw = second, first, -yaw
                predicted = inverse(track.T_odom_lidar[i]) @ track.T_odom_lidar[j] if a == b else None
                yield Candidate(
                    *first, *second, float(found.distance[k]), yaw, predicted,
                    float(found.score[k]) / settings.search.max_distance, found.source(int(k)),
                    float(found.temporal[k]), float(found.segment[k]),
                )  # fmt: skip
