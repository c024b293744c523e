"""Loops: places seen again, verified by geometry, with the reason for every candidate's fate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops, Places
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.loops.candidates import Candidate, CandidateSettings, Track, candidates, tracks_of
from scanloom.stages.loops.consistency import ConsistencySettings, inconsistent
from scanloom.stages.loops.reading import ScanShelf, joined
from scanloom.stages.loops.submaps import SubmapSettings, SubmapShelf
from scanloom.stages.loops.verification import Drift, Verdict, VerificationSettings, verify

VERSION = 1


class Settings(BaseModel):
    """How loops are found and what they must pass."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    candidates: CandidateSettings = Field(
        default_factory=CandidateSettings, description="where loops are looked for"
    )
    submaps: SubmapSettings = Field(default_factory=SubmapSettings, description="what is compared")
    verification: VerificationSettings = Field(
        default_factory=VerificationSettings, description="what a loop must pass"
    )
    consistency: ConsistencySettings = Field(
        default_factory=ConsistencySettings, description="how loops must agree"
    )


def loops(
    settings: Settings,
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    odometry: Parts[Odometry],
    places: Parts[Places],
) -> Loops:
    """All candidates of a map, accepted or rejected with the reason. Reads only the scans of submaps it verifies.

    Raises
    ------
    StageError : scans, labels, odometry and places do not belong together.
    """
    tracks, shelves = _tracks(deskewed, labels, odometry, places)
    found = candidates(settings.candidates, tracks)
    shelf = SubmapShelf(settings.submaps, tracks, shelves)
    verdicts = _verified(settings.verification, shelf, tracks, found)
    passed = [k for k, v in enumerate(verdicts) if not v.reason]
    gone = inconsistent(settings.consistency, tracks, [(found[k], verdicts[k].T_i_j) for k in passed])
    reasons = [v.reason for v in verdicts]
    for place, reason in gone.items():
        reasons[passed[place]] = reason
    return _table(tracks, found, verdicts, reasons)


def _tracks(
    deskewed: Parts[Deskewed], labels: Parts[Labels], odometry: Parts[Odometry], places: Parts[Places]
) -> tuple[list[Track], list[ScanShelf]]:
    clouds, classes = deskewed.by("session"), labels.by("session")
    described = {name: joined(list(chunks)) for name, chunks in places.by("session").items()}
    tracks, shelves = [], []
    for where, track in odometry.items():
        name = where["session"]
        if name not in described or name not in clouds or name not in classes:
            raise StageError(
                "odometry comes without scans, labels or places",
                where=f"session {name}",
                next_step="run the whole workflow",
            )
        shelf = ScanShelf(clouds[name], classes[name])
        for segment in tracks_of(name, track, described[name]):
            tracks.append(segment)
            shelves.append(shelf)
    return tracks, shelves


def _verified(
    settings: VerificationSettings, shelf: SubmapShelf, tracks: Sequence[Track], found: Sequence[Candidate]
) -> list[Verdict]:
    """Verdicts in the order of the candidates; taken place by place, so that clouds are read once for neighbours."""
    order = sorted(range(len(found)), key=lambda k: (found[k].b, found[k].j, found[k].a, found[k].i))
    verdicts = {
        k: verify(
            settings, found[k], _drift(tracks, found[k]), shelf.around(found[k].a, found[k].i),
            shelf.around(found[k].b, found[k].j),
        )
        for k in order
    }  # fmt: skip
    return [verdicts[k] for k in range(len(found))]


def _drift(tracks: Sequence[Track], c: Candidate) -> Drift:
    if c.a != c.b:
        return Drift(0.0)
    track = tracks[c.a]
    return Drift(
        float(track.travelled_m[c.j] - track.travelled_m[c.i]), *track.whereabouts.spread_m(c.i, c.j)
    )


def _table(
    tracks: Sequence[Track], found: Sequence[Candidate], verdicts: Sequence[Verdict], reasons: Sequence[str]
) -> Loops:
    return Loops(
        session_i=np.array([tracks[c.a].name for c in found], object),
        scan_i=np.array([tracks[c.a].scan_index[c.i] for c in found], np.int64),
        session_j=np.array([tracks[c.b].name for c in found], object),
        scan_j=np.array([tracks[c.b].scan_index[c.j] for c in found], np.int64),
        T_i_j=np.array([v.T_i_j for v in verdicts], float).reshape(-1, 4, 4),
        covariance=np.array([v.covariance for v in verdicts], float).reshape(-1, 6, 6),
        source=np.array([c.source for c in found], object),
        descriptor_distance=np.array([c.descriptor_distance for c in found], float),
        temporal_distance=np.array([c.temporal_distance for c in found], float),
        segment_distance=np.array([c.segment_distance for c in found], float),
        inlier_ratio=np.array([v.inlier_ratio for v in verdicts], float),
        rmse_m=np.array([v.rmse_m for v in verdicts], float),
        overlap=np.array([v.overlap for v in verdicts], float),
        seen_through=np.array([v.seen_through for v in verdicts], float),
        e1_m=np.array([v.e1_m for v in verdicts], float),
        rival=np.array([v.rival for v in verdicts], float),
        accepted=np.array([not r for r in reasons], np.bool_),
        reason=np.array([r or "passed every test" for r in reasons], object),
    )
