"""Doubts about a registration, and the search that follows them.

A scan laid onto the wrong place still has its ground on the ground, so the share of inliers hardly falls. What is upright
tells: its share that fits is compared with that of the scans before. Right registrations keep most of it, wrong ones
hardly ever.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.stages.geometry.registration import Registration
from scanloom.stages.geometry.se3 import F8, inverse, so3_log
from scanloom.stages.odometry.coarse import Window, headings, propose, rotations
from scanloom.stages.odometry.poses import apart
from scanloom.stages.odometry.prediction import Prediction

UPRIGHT_COSINE = 0.8
FLAT_WEIGHT = 0.1
"""Worth of a point on the ground beside one on something upright."""
DOUBTFUL, LEAST_EXPECTED, LEAST_SURPRISING = 0.75, 0.5, 0.6
"""Shares of the usual fit: below the first a better pose is searched for; below the others none is believed."""
LEAST_AHEAD = 0.95
MOST_OF_BEST = 0.85
"""A place that fits nearly as well as the best one makes it a guess."""
GAIN, FADING = 0.2, 0.97
REACH_M, FASTEST_CHANGE_M_S2, MOST_REACH_M = 1.5, 6.0, 20.0
RISE_M, SLOPE = 1.0, 0.1
SURE_RAD, TURN_RAD, TUMBLE_RAD, TUMBLE_REACH_M = 0.05, 0.05, np.radians(63.0), 3.0
APART_M, APART_RAD = 0.5, 0.05
TURN_COST, WAY_COST = 0.15, 0.1
"""Of two places that fit alike the nearer one is likelier: share of the fit that half a turn, and the farthest way, cost."""


@dataclass(frozen=True)
class Attempt:
    """A registration, whether a search and not the expected motion led to it, and whether it can be believed.

    sure : it fits as scans usually do, and much better than any other place.
    """

    registration: Registration
    searched: bool
    believed: bool
    sure: bool = True


class Recovery:
    """How well scans usually fit, and what to do with one that does not."""

    def __init__(self, T_base_lidar: F8) -> None:
        self._R_up: F8 = T_base_lidar[:3, :3]
        self.usual = 0.0
        """Running mean of `fit` over registered scans; 0 when there are none yet."""

    def fit(self, registration: Registration, points: int) -> float:
        """Weight of the partners found over that of all `points`, the ground counting little; 0 to 1."""
        up = (self._R_up @ registration.T_target_source[:3, :3]).T[:, 2]
        flat = np.abs(registration.normals @ up) > UPRIGHT_COSINE
        worth = np.where(flat, FLAT_WEIGHT, 1.0)
        whole = points - (1 - FLAT_WEIGHT) * np.count_nonzero(flat)
        return float(registration.weights @ worth) / max(whole, 1.0)

    def doubts(self, registration: Registration, points: int) -> bool:
        """Whether the scan fits so much worse than those before that it should be looked for elsewhere."""
        return self.fit(registration, points) < DOUBTFUL * self.usual

    def learn(self, fit: float | None) -> None:
        """Take note of how a registered scan fits; None when a scan was not registered."""
        if fit is None:
            self.usual *= FADING
        else:
            self.usual = self.usual + GAIN * (fit - self.usual) if self.usual else fit

    def search(
        self, tries: Sequence[Registration], align: Callable[[F8], Registration],
        sound: Callable[[Registration], bool], points_map: F8, points: F8, T_expected: F8, prediction: Prediction,
    ) -> Attempt | None:  # fmt: skip
        """The best of the sound registrations tried so far and of those that the coarse search leads to; None without any.

        `align` registers the scan from a pose; `sound` says whether a registration converged on enough points.
        """
        reach_m, n = reach_of(prediction), len(points)
        found: list[Registration] = []
        for window in windows(prediction, reach_m):
            proposals = propose(points_map, points, T_expected, self._R_up, window)
            found += [r for r in (align(p.T_map_scan) for p in proposals) if sound(r)]
            if any(self.fit(r, n) >= LEAST_SURPRISING * self.usual for r in (*tries, *found)):
                break
        near = [r for r in found if _distance(r.T_target_source, T_expected) <= reach_m + 1.0]
        if not tries and not near:
            return None
        return self._choose(
            tries, near, lambda r: self.fit(r, n) * _likelihood(r.T_target_source, T_expected)
        )

    def _choose(
        self, tries: Sequence[Registration], found: Sequence[Registration], merit: Callable[[Registration], float]
    ) -> Attempt:  # fmt: skip
        """The best of all, believed when it stands alone and fits as scans usually do; one of `tries` is as good if nearly so.

        Nothing is usual yet at the start of a map: then the best is taken at its word, and the next scan is to confirm it.
        """
        best = max([*tries, *found], key=merit)
        top = merit(best)
        direct = max(tries, key=merit) if tries else None
        if direct is not None and merit(direct) >= LEAST_AHEAD * top:
            return Attempt(direct, searched=False, believed=merit(direct) >= LEAST_EXPECTED * self.usual)
        T_best = best.T_target_source
        rivals = [merit(r) for r in (*tries, *found) if apart(r.T_target_source, T_best, APART_M, APART_RAD)]
        alone = max(rivals, default=0.0) < MOST_OF_BEST * top
        believed = not self.usual or (alone and top >= LEAST_SURPRISING * self.usual)
        return Attempt(best, searched=True, believed=believed, sure=alone and top >= DOUBTFUL * self.usual)


def reach_of(prediction: Prediction) -> float:
    """How far from where it was expected a scan may be, m: three standard deviations, and never out of the map."""
    std_m = float(np.sqrt(prediction.covariance[3:, 3:].diagonal().max()))
    return float(np.clip(3 * std_m, REACH_M, MOST_REACH_M))


def windows(prediction: Prediction, reach_m: float) -> list[Window]:
    """What to search, the likeliest first: headings; and where no gyro tells the turn, turns about any axis."""
    turn_std = float(np.sqrt(prediction.covariance[:3, :3].diagonal().max()))
    rise_m = RISE_M + SLOPE * reach_m
    if turn_std < SURE_RAD / 5:
        return [Window(headings(TURN_RAD), reach_m, rise_m)]
    near = min(reach_m, TUMBLE_REACH_M)
    return [Window(headings(np.pi), reach_m, rise_m), Window(rotations(TUMBLE_RAD), near, near)]


def _likelihood(T: F8, T_expected: F8) -> float:
    turn = float(np.linalg.norm(so3_log((inverse(T_expected) @ T)[:3, :3])))
    way = min(_distance(T, T_expected) / MOST_REACH_M, 1.0)
    return 1.0 - TURN_COST * turn / np.pi - WAY_COST * way


def _distance(a: F8, b: F8) -> float:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
