"""The map that is extended: what its poses say to the graph, and which of them stay.

`rigid`: a pose of the map is a fact. Each of its keyframes gets one stiff factor, fixes and loops of the old sessions are
not asked again, and the poses come out as they went in, bit by bit.

`soft`: old and new measurements are solved together. The old poses are where the search starts, and get no prior: what
their marginals sum up are the very loops, fixes and steps that are in the graph again, and a prior on each of them would
count these as often as there are keyframes. Spans that hardly move stay as they are, so that their tiles do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.base import Base
from scanloom.schemas.errors import StageError
from scanloom.schemas.frames import Georeference
from scanloom.schemas.product import Parts
from scanloom.schemas.trajectory import Poses
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.geometry.se3 import F8, adjoint, inverse, se3_exp, se3_log

I8 = NDArray[np.int64]

FIXED_SIGMA = (1e-4, 1e-3)
"""Rotation rad, translation m: stiff against any loop, soft enough for the solver."""
LEVER_M = 20.0
"""A turned pose moves what stands this far away; so far from the road most of a map lies."""
SPAN_M = 20.0
"""Path that stays or moves as one."""


@dataclass(frozen=True)
class BaseMap:
    """The map that is extended: its sessions by name, and its frame, which an extension never changes."""

    sessions: Mapping[str, Base]
    origin: Georeference | None

    def holds(self, session: str) -> bool:
        return session in self.sessions

    def new_among(self, sessions: Iterable[str]) -> frozenset[str]:
        """Those of `sessions` that the map does not hold."""
        return frozenset(sessions) - self.sessions.keys()


def base_map(base: Parts[Base] | None) -> BaseMap | None:
    """The map that the sessions of `base` come from; None when all are new.

    Raises
    ------
    StageError : the sessions stand in different frames.
    """
    found = {
        where["session"]: part for where, part in (base.items() if base is not None else ()) if len(part)
    }
    if not found:
        return None
    frames = [(part.frame, part.georeference) for part in found.values()]
    if any(frame != frames[0] for frame in frames):
        raise StageError(
            f"sessions {', '.join(found)} stand in different frames",
            next_step="extend a map as `scanloom map` or `scanloom extend` delivered it",
        )
    told = frames[0][1]
    return BaseMap(found, Georeference.model_validate(told) if told else None)


def known_poses(base: Base, scan_index: I8) -> tuple[I8, F8]:
    """Places in `scan_index` (n,) of the scans the map holds, and their poses (m, 4, 4) in it."""
    at = np.minimum(np.searchsorted(base.scan_index, scan_index), len(base) - 1)
    known = np.flatnonzero(base.scan_index[at] == scan_index)
    return known.astype(np.int64), np.asarray(base.T_world_lidar[at[known]])


def start_poses(base: Base, scan_index: I8, T_odom_lidar: F8) -> F8 | None:
    """Poses (n, 4, 4) in the map to start from: the map's own; scans it lacks are placed from a neighbour it has.

    None when the map holds none of these scans.
    """
    known, T_known = known_poses(base, scan_index)
    if not len(known):
        return None
    before = np.maximum(np.searchsorted(known, np.arange(len(scan_index)), side="right") - 1, 0)
    T = np.asarray(T_known[before] @ inverse(T_odom_lidar[known[before]]) @ T_odom_lidar)
    T[known] = T_known
    return T


def fixing(nodes: I8, T: F8) -> list[Factor]:
    """One stiff factor on each of `nodes` (n,) at its pose T (n, 4, 4) in the map."""
    covariance = np.diag(np.repeat(FIXED_SIGMA, 3) ** 2)
    return [Factor("base", int(node), -1, pose, covariance) for node, pose in zip(nodes, T, strict=True)]


def settled(solved: Poses, base: Base, *, rigid: bool, deadband_m: float) -> Poses:
    """Poses of an old session as they enter the new map.

    `rigid`: exactly the base's. Else spans of 20 m in which no pose moved by more than `deadband_m` (a turn counts by
    what it moves 20 m away) keep the base's exactly, and from their ends the motion grows over half a span to what the
    solution says, so that nothing tears where one that stays meets one that moves.
    """
    if rigid:
        return base.poses()
    rows = np.minimum(np.searchsorted(base.scan_index, solved.scan_index), len(base) - 1)
    known = base.scan_index[rows] == solved.scan_index
    before, after = base.T_world_lidar[rows], solved.T_world_lidar
    motion = np.where(known[:, None], se3_log(inverse(before) @ after), np.inf)
    path = _path(after)
    stays = _spans_that_stay(_moved(motion), path, deadband_m)
    share = _share(path, stays)
    moved = before @ se3_exp(share[:, None] * np.where(known[:, None], motion, 0.0))
    T = np.where((known & (share < 1.0))[:, None, None], moved, after)
    T[stays] = before[stays]
    covariance = np.where(stays[:, None, None], base.covariance[rows], solved.covariance)
    return replace(solved, T_world_lidar=T, covariance=covariance)


def inherited(solved: Poses, old: BaseMap) -> Poses:
    """Poses of a new session in `rigid` mode, with the map's own uncertainty added to their marginals.

    To the solver the map's poses are facts, so that it tells how well the session lies on the map. An error xi of the old
    keyframe j nearest to pose i moves i with it: C_i + A C_j A^T, A = Ad(T_i^-1 T_j).
    """
    from scipy.spatial import cKDTree

    nodes = [part.take(np.flatnonzero(part.keyframe)) for part in old.sessions.values()]
    T_old = np.concatenate([part.T_world_lidar for part in nodes])
    C_old = np.concatenate([part.covariance for part in nodes])
    if not len(T_old):
        return solved
    j = cKDTree(T_old[:, :3, 3]).query(solved.T_world_lidar[:, :3, 3])[1]
    A = adjoint(inverse(solved.T_world_lidar) @ T_old[j])
    return replace(solved, covariance=solved.covariance + A @ C_old[j] @ np.swapaxes(A, 1, 2))


def _moved(motion: F8) -> F8:
    """How far points 20 m away move, at most, by motions (n, 6) of (rotation, translation)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(
            np.linalg.norm(motion[:, 3:], axis=1) + LEVER_M * np.linalg.norm(motion[:, :3], axis=1)
        )


def _path(T: F8) -> F8:
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(step)))


def _spans_that_stay(moved: F8, path: F8, deadband_m: float) -> NDArray[np.bool_]:
    """(n,) true for poses of spans in which all moved by at most the deadband."""
    span = np.floor(path / SPAN_M).astype(np.int64)
    _, first, inside = np.unique(span, return_index=True, return_inverse=True)
    most = np.maximum.reduceat(moved, first)
    return np.asarray((most <= deadband_m)[inside])


def _share(path: F8, stays: NDArray[np.bool_]) -> F8:
    """(n,) share of its motion that each pose makes: 0 where it stays, 1 from half a span beyond."""
    if not stays.any():
        return np.ones(len(path))
    still = path[stays]
    after = np.clip(np.searchsorted(still, path), 1, max(len(still) - 1, 1))
    right = still[np.minimum(after, len(still) - 1)]
    gap = np.minimum(np.abs(path - still[after - 1]), np.abs(path - right))
    x = np.where(stays, 0.0, np.clip(gap / (0.5 * SPAN_M), 0.0, 1.0))
    return np.asarray(x * x * (3.0 - 2.0 * x))


# --- what a user should know ----------------------------------------------------------------------------------------

SEPARATE_M = 20.0
"""Loops nearer to each other than this, along the path, say the same thing and count as one."""


def separate(path_m: Sequence[float] | F8) -> int:
    """How many loops at these places along a path are more than 20 m from the next one counted."""
    count, last = 0, -np.inf
    for place in np.sort(np.asarray(path_m, float)):
        if place - last > SEPARATE_M:
            count, last = count + 1, place
    return count


def remark_on_ties(session: str, places_m: Sequence[float] | F8, *, by_gnss: bool) -> str:
    """What to say of a new session that loops tie to the map at these places along its path; empty when all is well."""
    ties = separate(places_m)
    if ties >= 2:
        return ""
    held = "GNSS alone holds" if by_gnss else "nothing holds"
    if ties == 1:
        text = f"session {session} hangs on one loop to the others only; {held} its far end, which may drift"
    else:
        text = f"session {session} meets no other session; {held} it in its place"
    return text + ": drive a second stretch that both have, or look at the report before you trust it"
