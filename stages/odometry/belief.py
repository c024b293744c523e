"""How well the pose in the local map is known, from scan to scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.geometry.se3 import F8, adjoint, inverse
from scanloom.stages.odometry.prediction import Prediction


@dataclass(frozen=True)
class Belief:
    """Covariance (6, 6) of the last pose in the local map, right tangent, and what it means for the motion to the next.

    A Kalman filter over the tangent of the pose. With P of the last pose carried to the new frame, Q of the predicted
    motion and R of the registration, the new pose has P+ = ((P + Q)^-1 + R^-1)^-1 and the gain K = P+ R^-1. The error of
    the new pose is (1 - K)(e + q) + K r, so that of the motion since the last one is -K e + (1 - K) q + K r: for a good
    scan 2 R, the difference of two registrations; for a blind one Q.
    """

    covariance: F8

    def expected(self, prediction: Prediction) -> F8:
        """P + Q (6, 6) of the predicted pose."""
        return self._carried(prediction) + prediction.covariance

    def predicted(self, prediction: Prediction) -> Belief:
        """After a motion that is prediction alone."""
        return Belief(self.expected(prediction))

    def registered(self, prediction: Prediction, information: F8) -> tuple[Belief, F8]:
        """After a registration with R^-1 = `information` (6, 6); and the covariance (6, 6) of the motion to it."""
        carried, predicted = self._carried(prediction), prediction.covariance
        joint = np.linalg.inv(np.linalg.inv(carried + predicted) + information)
        after = _symmetric(np.asarray(joint, np.float64))
        gain = after @ information
        rest = np.eye(6) - gain
        noise = after @ information @ after
        motion = gain @ carried @ gain.T + rest @ predicted @ rest.T + noise
        return Belief(after), _symmetric(motion)

    def _carried(self, prediction: Prediction) -> F8:
        turn = adjoint(inverse(prediction.T_last_now))
        carried: F8 = turn @ self.covariance @ turn.T
        return carried


def _symmetric(a: F8) -> F8:
    """The symmetric part of a matrix (n, n): rounding leaves another."""
    half: F8 = 0.5 * (a + a.T)
    return half
