"""The map that is extended, in the graph: where its sessions start, what holds them, what is said of the new ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from scanloom.schemas.trajectory import Poses
from scanloom.stages.fusion.base import (
    BaseMap,
    fixing,
    inherited,
    known_poses,
    remark_on_ties,
    settled,
    start_poses,
)
from scanloom.stages.fusion.drives import I8, Drive
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.gnss import Fixes
from scanloom.stages.fusion.settings import Settings
from scanloom.stages.geometry.se3 import F8

FROM_MAP = "not asked: the poses are those of the map that is extended"
NO_PLACE = "not used: the map that is extended has no place on the Earth"


def on_base(drives: Sequence[Drive], old: BaseMap | None) -> tuple[list[Drive], dict[int, F8]]:
    """Drives whose odometry is where the old map has them, with the identity as T_map_odom of each of these."""
    if old is None:
        return list(drives), {}
    moved, placed = list(drives), {}
    for k, d in enumerate(drives):
        if not old.holds(d.name):
            continue
        T = start_poses(old.sessions[d.name], d.odometry.scan_index, d.odometry.T_odom_lidar)
        if T is not None:
            moved[k] = replace(d, odometry=replace(d.odometry, T_odom_lidar=T))
            placed[k] = np.eye(4)
    return moved, placed


def in_frame_of(old: BaseMap | None, fixes: Sequence[Fixes]) -> list[Fixes]:
    """A map without place on the Earth gets none by being extended: its frame stays, and no fix can be used in it."""
    if old is None or old.origin is not None:
        return list(fixes)
    return [
        replace(f, alignment=None, verdict=np.where(f.verdict == "", NO_PLACE, f.verdict).astype(object))
        for f in fixes
    ]


def held(
    settings: Settings, factors: list[Factor], drives: Sequence[Drive], old: BaseMap | None
) -> list[Factor]:
    """The factors of an extension: in `rigid` mode a stiff one on each old pose in place of old fixes and loops."""
    if old is None:
        return factors
    nodes, T = _old_nodes(drives, old)
    if settings.extension == "soft":
        return _soft(factors, nodes, T, georeferenced=old.origin is not None)
    within = set(nodes.tolist()) | {-1}
    return fixing(nodes, T) + [
        replace(f, verdict=f.verdict or FROM_MAP) if f.doubted and f.i in within and f.j in within else f
        for f in factors
        if f.kind != "prior"
    ]


def _soft(factors: list[Factor], nodes: I8, T: F8, *, georeferenced: bool) -> list[Factor]:
    """All measurements again; where none tells the place on the Earth, the first old pose holds the frame."""
    if georeferenced:
        return factors
    return fixing(nodes[:1], T[:1]) + [f for f in factors if f.kind != "prior"]


def _old_nodes(drives: Sequence[Drive], old: BaseMap) -> tuple[I8, F8]:
    """Nodes (n,) of keyframes that the old map holds, and their poses (n, 4, 4) in it."""
    found = []
    for d in drives:
        if old.holds(d.name):
            keyframes, T = known_poses(old.sessions[d.name], d.odometry.scan_index[d.keyframes])
            found.append((d.nodes[keyframes], T))
    return np.concatenate([n for n, _ in found]), np.concatenate([T for _, T in found])


def final(settings: Settings, name: str, solved: Poses, old: BaseMap | None) -> Poses:
    """Poses of a session as the new map has them."""
    if old is None:
        return solved
    rigid = settings.extension == "rigid"
    if not old.holds(name):
        return inherited(solved, old) if rigid else solved
    return settled(solved, old.sessions[name], rigid=rigid, deadband_m=settings.extension_deadband_m)


def on_ties(
    drives: Sequence[Drive], fixes: Sequence[Fixes], factors: Sequence[Factor],
    old: BaseMap | None,
) -> list[str]:  # fmt: skip
    """Sentences on sessions that hang on the others by too little.

    In an extension every new session is looked at; in a map of several sessions those that GNSS does not place, but for
    the first, which then defines the frame.
    """
    by_gnss = {d.name for d, f in zip(drives, fixes, strict=True) if f.alignment is not None}
    names = list(dict.fromkeys(d.name for d in drives))
    if old is not None:
        asked = [name for name in names if not old.holds(name)]
    else:
        asked = [name for name in names if name not in by_gnss]
        asked = asked if by_gnss else asked[1:]
    places = _places_of_ties(drives, factors)
    return [
        text
        for name in asked
        if (text := remark_on_ties(name, places.get(name, []), by_gnss=name in by_gnss))
    ]


def _places_of_ties(drives: Sequence[Drive], factors: Sequence[Factor]) -> Mapping[str, list[float]]:
    """Where along its path, m, each session is tied to another one by a loop that the graph believes."""
    first = np.array([d.first_node for d in drives])
    before = _path_before(drives)
    places: dict[str, list[float]] = {}
    for f in factors:
        if f.kind != "loop" or f.verdict or f.weight < 0.5:
            continue
        a, b = (int(np.searchsorted(first, node, side="right")) - 1 for node in (f.i, f.j))
        if drives[a].name == drives[b].name:
            continue
        for k, node in ((a, f.i), (b, f.j)):
            d = drives[k]
            at = d.travelled_m[d.keyframes[node - d.first_node]]
            places.setdefault(d.name, []).append(before[k] + float(at))
    return places


def _path_before(drives: Sequence[Drive]) -> list[float]:
    """Path of the segments of the same session before each drive, m."""
    out: list[float] = []
    for k, d in enumerate(drives):
        follows = k > 0 and drives[k - 1].name == d.name
        out.append(out[k - 1] + float(drives[k - 1].travelled_m[-1]) if follows else 0.0)
    return out
