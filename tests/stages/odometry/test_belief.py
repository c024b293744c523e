"""What is known of a pose in the map, against drawn errors."""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, se3_log, so3_exp
from scanloom.stages.odometry.belief import Belief
from scanloom.stages.odometry.prediction import Prediction

STEP = pose(so3_exp([0, 0, 0.1]), [1.0, 0.2, 0])
Q = np.diag([1e-3**2] * 3 + [0.02**2] * 3)
R = np.diag([2e-4**2] * 3 + [0.002**2] * 3)


def predicted(Q: F8) -> Prediction:
    return Prediction(STEP, STEP, Q, measured=True, known=True)


def test_the_motion_between_two_good_registrations_has_twice_the_error_of_one() -> None:
    belief = Belief(R)
    after, motion = belief.registered(predicted(1e6 * np.eye(6)), np.linalg.inv(R))
    np.testing.assert_allclose(np.diagonal(after.covariance), np.diagonal(R), rtol=1e-3)
    assert (np.diagonal(motion) > 1.9 * np.diagonal(R)).all()
    np.testing.assert_allclose(motion[3, 3], 2 * R[3, 3], rtol=0.1)


def test_a_blind_scan_leaves_the_prediction() -> None:
    belief = Belief(R)
    after, motion = belief.registered(predicted(Q), np.zeros((6, 6)))
    np.testing.assert_allclose(motion, Q, rtol=1e-9)
    np.testing.assert_allclose(after.covariance, belief.expected(predicted(Q)), rtol=1e-9, atol=1e-15)
    assert belief.predicted(predicted(Q)).covariance[3, 3] > Q[3, 3]


def test_covariances_match_drawn_errors() -> None:
    """A thousand drives of six scans, filtered with the same gains: the errors have the covariance that was told."""
    rng = np.random.default_rng(0)
    prediction, information = predicted(Q), np.linalg.inv(R)
    pose_nees, motion_nees = [], []
    for _ in range(300):
        belief, error = Belief(R), se3_exp(rng.multivariate_normal(np.zeros(6), R))
        for _ in range(6):
            before = error
            expected = inverse(STEP) @ error @ STEP @ se3_exp(rng.multivariate_normal(np.zeros(6), Q))
            measured = se3_exp(rng.multivariate_normal(np.zeros(6), R))
            belief, covariance = belief.registered(prediction, information)
            gain = belief.covariance @ information
            error = expected @ se3_exp(gain @ se3_log(inverse(expected) @ measured))
            moved = se3_log(inverse(STEP) @ inverse(before) @ STEP @ error)
            motion_nees.append(moved @ np.linalg.solve(covariance, moved))
        xi = se3_log(error)
        pose_nees.append(xi @ np.linalg.solve(belief.covariance, xi))
    assert 5 < np.mean(pose_nees) < 7
    assert 5.5 < np.mean(motion_nees) < 6.5
