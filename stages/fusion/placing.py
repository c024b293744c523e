"""Which frame the map has, and where GNSS puts each session in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scanloom.schemas.frames import Georeference
from scanloom.schemas.tracks import Gnss
from scanloom.stages.fusion.base import BaseMap
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.fusion.extending import in_frame_of
from scanloom.stages.fusion.gnss import Fixes, judge, middle, screen
from scanloom.stages.fusion.gravity import Gravity, level
from scanloom.stages.fusion.settings import Settings
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.geometry.se3 import F8, pose


def place_by_gnss(
    settings: Settings, drives: Sequence[Drive], ups: Sequence[Gravity], old: BaseMap | None = None
) -> tuple[Georeference | None, list[Fixes]]:
    """Fixes of all sessions in the frame `world` of the first session whose GNSS tells its place; else None.

    A map that is extended keeps its frame.
    """
    verdicts = [screen(settings.gnss, d) for d in drives]
    levels = [level(d, up) for d, up in zip(drives, ups, strict=True)]
    origin = old.origin if old is not None else _origin(settings, drives, verdicts, levels)
    judged = []
    for d, verdict, R in zip(drives, verdicts, levels, strict=True):
        judged.append(judge(settings.gnss, d, verdict, origin or middle(d.gnss), R))
    return origin, in_frame_of(old, judged)


def _origin(
    settings: Settings, drives: Sequence[Drive], verdicts: Sequence[np.ndarray], levels: Sequence[F8]
) -> Georeference | None:
    """At the first accepted fix of the first drive that GNSS places; None when it places none."""
    for d, verdict, R in zip(drives, verdicts, levels, strict=True):
        trial = _judged_at_first_fix(settings, d, verdict, R)
        if trial is not None:
            return trial
    return None


def _judged_at_first_fix(settings: Settings, d: Drive, verdict: np.ndarray, R: F8) -> Georeference | None:
    """Georeference at the first fix that enters the graph, when GNSS tells the session's place."""
    passed = np.flatnonzero(verdict == "")
    if not len(passed):
        return None
    fixes = judge(settings.gnss, d, verdict, middle(d.gnss.take(passed)), R)
    used = np.flatnonzero(fixes.verdict == "")
    if fixes.alignment is None or not len(used):
        return None
    return _georeference(d.gnss, int(used[0]))


def _georeference(gnss: Gnss, row: int) -> Georeference:
    return georeference(
        float(gnss.latitude_deg[row]), float(gnss.longitude_deg[row]), float(gnss.height_m[row])
    )


def placed(
    drives: Sequence[Drive], ups: Sequence[Gravity], fixes: Sequence[Fixes], known: Mapping[int, F8]
) -> dict[int, F8]:
    """T_map_odom of the drives: as `known`, else by GNSS; without any, the first session defines the frame `map`."""
    out = {}
    for k, (d, up, f) in enumerate(zip(drives, ups, fixes, strict=True)):
        if f.alignment is not None:
            out[k] = f.alignment.T_world_level @ pose(level(d, up), np.zeros(3))
    out.update(known)
    if not out:
        out[0] = pose(level(drives[0], ups[0]), np.zeros(3))
    return out
