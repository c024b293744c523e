"""Loops must agree with each other: the cycle of two loops and the odometry between their ends must close."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.geometry.se3 import F8, inverse, se3_log
from scanloom.stages.loops.candidates import Candidate, Track


class ConsistencySettings(BaseModel):
    """How well cycles must close."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach_m: float = Field(
        default=150.0,
        gt=0,
        le=1e5,
        description="loops farther apart than this on either pass are not compared, m",
    )
    tolerance_m: float = Field(default=0.5, gt=0, le=50, description="misclosure always allowed, m")
    tolerance_deg: float = Field(default=2.0, gt=0, le=90, description="misclosure always allowed, deg")
    drift_share: float = Field(
        default=0.02, gt=0, le=1, description="misclosure allowed per metre of odometry in the cycle"
    )
    drift_deg_m: float = Field(
        default=0.03, gt=0, le=10, description="misclosure allowed per metre of odometry in the cycle, deg/m"
    )
    trusted_path_m: float = Field(
        default=600.0,
        ge=0,
        le=1e5,
        description="a lone loop after at most this much path may be confirmed by odometry itself, m",
    )


@dataclass(frozen=True)
class _Pairs:
    agree: NDArray[np.bool_]
    contradict: NDArray[np.bool_]


def inconsistent(
    settings: ConsistencySettings, tracks: Sequence[Track], loops: Sequence[tuple[Candidate, F8]]
) -> dict[int, str]:
    """Which of the loops (candidate, T_i_j) to give up, by position, and why.

    Of two that contradict each other the one with fewer friends goes, until none contradict. What then has neither a
    friend nor the odometry of its own session on its side goes too.
    """
    pairs = _compare(settings, tracks, loops)
    gone: dict[int, str] = {}
    alive = np.ones(len(loops), bool)
    while True:
        conflicts = (pairs.contradict & alive & alive[:, None]).sum(axis=1)
        if not conflicts.any():
            break
        friends = (pairs.agree & alive).sum(axis=1)
        worst = max(np.flatnonzero(conflicts), key=lambda k: (conflicts[k] - friends[k], k))
        alive[worst] = False
        gone[int(worst)] = "contradicts another loop through odometry"
    for k in np.flatnonzero(alive):
        if not (pairs.agree[k] & alive).any() and not _odometry_agrees(settings, tracks, *loops[int(k)]):
            gone[int(k)] = "no other loop confirms it"
    return gone


def _compare(
    settings: ConsistencySettings, tracks: Sequence[Track], loops: Sequence[tuple[Candidate, F8]]
) -> _Pairs:
    n = len(loops)
    agree, contradict = np.zeros((n, n), bool), np.zeros((n, n), bool)
    for k in range(n):
        for m in range(k):
            closes = _cycle_closes(settings, tracks, loops[k], loops[m])
            if closes is not None:
                agree[k, m] = agree[m, k] = closes
                contradict[k, m] = contradict[m, k] = not closes
    return _Pairs(agree, contradict)


def _cycle_closes(
    settings: ConsistencySettings,
    tracks: Sequence[Track],
    one: tuple[Candidate, F8],
    two: tuple[Candidate, F8],
) -> bool | None:
    """Whether T_i1_j1 and T_i2_j2 agree through odometry; None when they lie too far apart to tell."""
    (c, T_c), (d, T_d) = one, two
    if (c.a, c.b) != (d.a, d.b):
        return None
    path = abs(tracks[c.a].travelled_m[c.i] - tracks[c.a].travelled_m[d.i])
    other = abs(tracks[c.b].travelled_m[c.j] - tracks[c.b].travelled_m[d.j])
    if max(path, other) > settings.reach_m:
        return None
    T_a, T_b = tracks[c.a].T_odom_lidar, tracks[c.b].T_odom_lidar
    around = inverse(T_c) @ inverse(T_a[c.i]) @ T_a[d.i] @ T_d @ inverse(T_b[d.j]) @ T_b[c.j]
    return _small(settings, around, float(path + other))


def _small(settings: ConsistencySettings, T: F8, path_m: float) -> bool:
    xi = se3_log(T)
    return bool(
        np.linalg.norm(xi[3:]) <= settings.tolerance_m + settings.drift_share * path_m
        and np.degrees(np.linalg.norm(xi[:3])) <= settings.tolerance_deg + settings.drift_deg_m * path_m
    )


def _odometry_agrees(settings: ConsistencySettings, tracks: Sequence[Track], c: Candidate, T_i_j: F8) -> bool:
    if c.predicted is None:
        return False
    path = float(tracks[c.b].travelled_m[c.j] - tracks[c.a].travelled_m[c.i])
    return path <= settings.trusted_path_m and _small(settings, inverse(c.predicted) @ T_i_j, path)
