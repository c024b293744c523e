"""Loop candidates: keyframes that may show the same place, by descriptor and by odometry's position.

The descriptor search is two-stage as in Scan Context: ring keys (rotation invariant) pick neighbours, then the
column-shifted cosine distance tells how alike they are and from which heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Places
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, inverse

I8 = NDArray[np.int64]
F4 = NDArray[np.float32]

LEAST_COMMON_COLUMNS = 12
BESIDE_M = np.array([-4.0, -2.0, 2.0, 4.0])
NEIGHBOURHOOD_MARGIN = 0.05
TAU = 2 * np.pi


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
    neighbours: int = Field(default=10, ge=1, le=100, description="ring keys compared in full per search")
    max_descriptor_distance: float = Field(
        default=0.45, gt=0, le=1, description="less alike places are no candidates"
    )
    radius_m: float = Field(
        default=12.0, gt=0, le=200, description="odometry positions closer than this are candidates, m"
    )
    radius_growth: float = Field(
        default=0.02, ge=0, le=0.5, description="growth of that radius per metre driven in between"
    )
    max_radius_m: float = Field(default=30.0, gt=0, le=500, description="largest such radius, m")
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
    descriptor: F4

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
    parts = [np.flatnonzero(odometry.segment[rows] == s) for s in np.unique(odometry.segment[rows])]
    return [
        Track(
            name,
            places.scan_index[part],
            odometry.stamp_ns[rows[part]],
            odometry.T_odom_lidar[rows[part]],
            travelled[rows[part]],
            places.descriptor[part],
        )
        for part in parts or [np.zeros(0, np.int64)]
    ]


def candidates(settings: CandidateSettings, tracks: Sequence[Track]) -> list[Candidate]:
    """The most promising candidates of all sessions, thinned along the tracks, best first."""
    found = _by_position(settings, tracks) + _by_descriptor(settings, tracks)
    found.sort(key=lambda c: (c.score, c.b, c.j, c.a, c.i))
    driven_m = sum(float(t.travelled_m[-1] - t.travelled_m[0]) for t in tracks if len(t))
    most = max(20, int(settings.per_km * driven_m / 1000.0))
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


def _queries(track: Track, spacing_m: float) -> I8:
    """The first keyframe of every stretch of path."""
    return np.unique(np.floor(track.travelled_m / spacing_m), return_index=True)[1].astype(np.int64)


def _ordered(
    tracks: Sequence[Track], a: int, i: int, b: int, j: int, distance: float, yaw: float, score: float
) -> Candidate:  # fmt: skip
    """A candidate with its earlier scan first; `yaw` is the heading of (b, j) in (a, i)."""
    if tracks[a].stamp_ns[i] > tracks[b].stamp_ns[j]:
        a, i, b, j, yaw = b, j, a, i, -yaw
    predicted = inverse(tracks[a].T_odom_lidar[i]) @ tracks[b].T_odom_lidar[j] if a == b else None
    return Candidate(a, i, b, j, distance, yaw, predicted, score)


# --------------------------------------------------------------------------------------------------------- by position


def _by_position(settings: CandidateSettings, tracks: Sequence[Track]) -> list[Candidate]:
    """For each search position, the nearest earlier keyframe of the same session within a radius that grows with path."""
    found = []
    for number, track in enumerate(tracks):
        position = track.T_odom_lidar[:, :3, 3]
        for j in _queries(track, settings.query_spacing_m):
            apart = track.travelled_m[j] - track.travelled_m[:j]
            radius = np.minimum(settings.radius_m + settings.radius_growth * apart, settings.max_radius_m)
            distance = np.linalg.norm(position[:j, :2] - position[j, :2], axis=1)
            old = (apart >= settings.min_path_m) & (
                track.stamp_ns[j] - track.stamp_ns[:j] >= settings.min_time_s * 1e9
            )
            share = np.where(old & (distance < radius), distance / np.maximum(radius, 1e-9), np.inf)
            if len(share) and np.isfinite(share.min()):
                found.append(
                    _ordered(
                        tracks,
                        number,
                        int(np.argmin(share)),
                        number,
                        int(j),
                        np.nan,
                        np.nan,
                        float(share.min()),
                    )
                )
    return found


# ------------------------------------------------------------------------------------------------------- by descriptor


def _by_descriptor(settings: CandidateSettings, tracks: Sequence[Track]) -> list[Candidate]:
    """For each search position, the most alike earlier keyframe of each session."""
    found = []
    units = [_unit_columns(t.descriptor) for t in tracks]
    keys = [t.descriptor.mean(axis=2) for t in tracks]
    for b, track in enumerate(tracks):
        queries = _queries(track, settings.query_spacing_m)
        for a in range(b + 1):
            if not len(tracks[a]):
                continue
            best, distance, shift = _search(
                keys[a], units[a], tracks[a].stamp_ns, tracks[a].travelled_m, keys[b], units[b], track.stamp_ns,
                track.travelled_m, queries, a == b, settings.min_path_m, int(settings.min_time_s * 1e9),
                settings.neighbours,
            )  # fmt: skip
            for k in np.flatnonzero((best >= 0) & (distance <= settings.max_descriptor_distance)):
                i, j = int(best[k]), int(queries[k])
                around = _neighbourhood_distance(units[a], units[b], _beside(tracks[a], i), _beside(track, j))
                if around > settings.max_descriptor_distance + NEIGHBOURHOOD_MARGIN:
                    continue
                yaw = float((shift[k] / track.descriptor.shape[2] * TAU + np.pi) % TAU - np.pi)
                score = 0.5 * (float(distance[k]) + around) / settings.max_descriptor_distance
                found.append(_ordered(tracks, a, i, b, j, float(distance[k]), yaw, score))
    return found


def _beside(track: Track, k: int) -> I8:
    """Keyframes (4,) nearest to 4 and 2 m before and 2 and 4 m after keyframe k."""
    wanted = track.travelled_m[k] + BESIDE_M
    after = np.clip(np.searchsorted(track.travelled_m, wanted), 0, len(track) - 1)
    return np.asarray(after, np.int64)


def _neighbourhood_distance(units_a: F4, units_b: F4, beside_i: I8, beside_j: I8) -> float:
    """Mean distance of the neighbours of i and j, driven in the same or in the opposite direction (STV-SC's temporal check).

    A place that looks alike by accident has neighbours that do not.
    """
    same = [_distance(units_a[i], units_b[j])[0] for i, j in zip(beside_i, beside_j, strict=True)]
    opposite = [_distance(units_a[i], units_b[j])[0] for i, j in zip(beside_i[::-1], beside_j, strict=True)]
    return float(min(np.mean(same), np.mean(opposite)))


def _unit_columns(descriptor: F4) -> F4:
    """Descriptors as (n, sectors, rings) with columns of length 1, or 0 where empty."""
    columns = np.ascontiguousarray(np.swapaxes(descriptor, 1, 2))
    length = np.linalg.norm(columns, axis=2, keepdims=True)
    return np.asarray(np.where(length > 0, columns / np.maximum(length, 1e-9), 0), np.float32)


def descriptor_distance(descriptor_i: F4, descriptor_j: F4) -> tuple[float, float]:
    """Scan context distance (0 same, 1 different) and the heading of j in i, rad, of two descriptors (20, 60)."""
    u = _unit_columns(np.stack((descriptor_i, descriptor_j)))
    distance, shift = _distance(u[0], u[1])
    return float(distance), float((shift / descriptor_i.shape[1] * TAU + np.pi) % TAU - np.pi)


@kernel
def _search(
    keys_a: F4, units_a: F4, stamp_a: I8, path_a: F8, keys_b: F4, units_b: F4, stamp_b: I8, path_b: F8, queries: I8,
    same: bool, min_path: float, min_ns: int, neighbours: int,
) -> tuple[I8, F8, I8]:  # fmt: skip
    best = np.full(len(queries), -1, np.int64)
    distance = np.ones(len(queries))
    shift = np.zeros(len(queries), np.int64)
    near = np.empty(neighbours, np.int64)
    near_d = np.empty(neighbours)
    for q in range(len(queries)):
        j = queries[q]
        count = 0
        for i in range(len(keys_a)):
            if same and (path_b[j] - path_a[i] < min_path or stamp_b[j] - stamp_a[i] < min_ns):
                continue
            d = 0.0
            for r in range(keys_a.shape[1]):
                e = float(keys_a[i, r] - keys_b[j, r])
                d += e * e
            if count == neighbours and d >= near_d[count - 1]:
                continue
            at = count if count < neighbours else neighbours - 1
            while at > 0 and near_d[at - 1] > d:
                near_d[at], near[at] = near_d[at - 1], near[at - 1]
                at -= 1
            near_d[at], near[at] = d, i
            count = min(count + 1, neighbours)
        for k in range(count):
            d, s = _distance(units_a[near[k]], units_b[j])
            if d < distance[q]:
                best[q], distance[q], shift[q] = near[k], d, s
    return best, distance, shift


@kernel
def _distance(unit_i: F4, unit_j: F4) -> tuple[float, int]:
    """Smallest mean cosine distance over column shifts; column s of i faces column s - shift of j."""
    sectors, rings = unit_i.shape
    best, best_shift = 1.0, 0
    for shift in range(sectors):
        common = 0
        total = 0.0
        for s in range(sectors):
            t = s - shift
            if t < 0:
                t += sectors
            dot = 0.0
            for r in range(rings):
                dot += unit_i[s, r] * unit_j[t, r]
            if dot > 0.0:
                common += 1
                total += dot
        if common >= LEAST_COMMON_COLUMNS and 1.0 - total / common < best:
            best, best_shift = 1.0 - total / common, shift
    return best, best_shift
