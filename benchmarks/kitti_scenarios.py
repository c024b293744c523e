"""What is done to the fixes of KITTI 00 before the fusion sees them; every fix keeps reporting that it is good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8

SEEDS = range(5)
OUTAGES_S = (30.0, 90.0, 150.0, 210.0, 270.0, 330.0)
OUTAGE_S = 120.0
LYING_SHARE = 0.2
LIE_M = (5.0, 30.0)
BURSTS, BURST_S, BURST_SIGMA_M, APART_S = 5, 20.0, 12.0, 30.0


@dataclass(frozen=True)
class Scenario:
    """Positions (m, 3), which of them were moved (m,), which are left in the log (m,), and what was done, in words."""

    name: str
    position_m: F8
    moved: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    words: str


def scenarios(time_s: F8, position_m: F8) -> Iterator[Scenario]:
    """All of them; those of one name differ by their seed or their place."""
    nothing, everything = np.zeros(len(time_s), bool), np.ones(len(time_s), bool)
    yield Scenario("gnss", position_m, nothing, everything, "all fixes as they are")
    for seed in SEEDS:
        shift, moved = _lies(len(time_s), np.random.default_rng(seed))
        words = "each fifth fix, on average, moved by 5 to 30 m in any direction"
        yield Scenario("gnss_lies", position_m + shift, moved, everything, words)
    for seed in SEEDS:
        shift, moved = _bursts(time_s, np.random.default_rng(seed))
        words = "five bursts of 20 s, each moved together by 12 m (one sigma) east and north"
        yield Scenario("gnss_bursts", position_m + shift, moved, everything, words)
    for start in OUTAGES_S:
        kept = (time_s < start) | (time_s >= start + OUTAGE_S)
        yield Scenario("gnss_outage_120s", position_m, nothing, kept, "no fix for 120 s")


def _lies(count: int, rng: np.random.Generator) -> tuple[F8, NDArray[np.bool_]]:
    moved = rng.random(count) < LYING_SHARE
    shift = _sideways(rng.uniform(*LIE_M, count), rng.uniform(0.0, 2.0 * np.pi, count))
    return shift * moved[:, None], moved


def _bursts(time_s: F8, rng: np.random.Generator) -> tuple[F8, NDArray[np.bool_]]:
    """Bursts at random times at least `APART_S` from start to start."""
    shift = np.zeros((len(time_s), 3))
    last = time_s[-1] - BURST_S - APART_S * (BURSTS - 1)
    starts = np.sort(rng.uniform(time_s[0], last, BURSTS)) + APART_S * np.arange(BURSTS)
    for start in starts:
        inside = (time_s >= start) & (time_s < start + BURST_S)
        shift[inside, :2] = rng.normal(0.0, BURST_SIGMA_M, 2)
    return shift, np.asarray(shift.any(axis=1))


def _sideways(length_m: F8, direction_rad: F8) -> F8:
    """East, north, up (n, 3) of horizontal shifts."""
    return np.column_stack(
        (length_m * np.cos(direction_rad), length_m * np.sin(direction_rad), np.zeros(len(length_m)))
    )
