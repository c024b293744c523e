"""Scans that fit nowhere in the map, kept aside: if they fit each other they become the map.

Where sensors did not tell how they were reached, a new segment begins with them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from scanloom.stages.geometry.registration import SurfelMap
from scanloom.stages.geometry.se3 import F8, se3_exp, se3_log
from scanloom.stages.odometry.prediction import Prediction

ENOUGH_SCANS = 4
UNKNOWN_RAD, UNKNOWN_M, UNKNOWN_M_S = 1.0, 5.0, 20.0
SURE_TURN_RAD = 0.01


@dataclass
class Aside:
    """A map of scans in succession, each registered to those before it. `first` is the row of the first."""

    map: SurfelMap
    first: int
    measured: bool
    """Whether sensors told the motion from the row before the first; `covariance` (6, 6) is that of this motion."""
    covariance: F8
    scans: int = 0

    def insert(self, points: F8) -> None:
        """One more scan, in the frame of the map."""
        self.map.insert(points)
        self.scans += 1

    @property
    def enough(self) -> bool:
        return self.scans >= ENOUGH_SCANS


def untold(pause_s: float) -> F8:
    """Covariance (6, 6) of a motion that nothing tells, (rad, m): the longer the pause, the farther it may have gone."""
    return np.diag([UNKNOWN_RAD**2] * 3 + [(UNKNOWN_M + UNKNOWN_M_S * pause_s) ** 2] * 3)


def unknown_motion(prediction: Prediction, pause_s: float) -> F8:
    """Covariance (6, 6) of a motion that neither sensors nor scans tell; a gyro's word on the turn is kept."""
    covariance = untold(pause_s)
    turn = prediction.covariance[:3, :3]
    if turn.diagonal().max() < SURE_TURN_RAD**2:
        covariance[:3, :3] = turn
    return covariance


@dataclass(frozen=True)
class Unconfirmed:
    """A scan that was found where nobody expected it: it enters the map when the next scan agrees.

    `T` is its pose, `T_before` and `twist` (6,) the pose and the motion before it, `covariance` that of the motion it was
    expected to make.
    """

    fine: F8
    T_before: F8
    before_ns: int
    twist: F8
    covariance: F8
    expectable: bool
    """Whether anything told where to expect it."""
    T: F8
    sure: bool

    @classmethod
    def of(cls, T_before: F8, fine: F8, before_ns: int, now_ns: int, prediction: Prediction) -> Unconfirmed:
        """`now_ns` is the time of the scan. It is not found yet: see `found`."""
        twist = se3_log(prediction.steady) / (1e-9 * (now_ns - before_ns))
        return cls(fine, T_before, before_ns, twist, prediction.covariance, prediction.known, T_before, False)

    def found(self, T: F8, *, sure: bool) -> Unconfirmed:
        """The same at pose T (4, 4); `sure`: it fits so well there that it is not to be doubted any more."""
        return dataclasses.replace(self, T=T, sure=sure)

    def expected(self, now_ns: int) -> F8:
        """Pose (4, 4) at a later time if this scan had never been."""
        T: F8 = self.T_before @ se3_exp(self.twist * 1e-9 * (now_ns - self.before_ns))
        return T
