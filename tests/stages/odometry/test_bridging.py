"""Guessed motions between sure poses: what was missing goes where the doubt is."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, se3_log
from scanloom.stages.odometry.bridging import close_gap

TIGHT = np.diag([1e-8] * 3 + [1e-6] * 3)
WIDE = np.diag([1e-2] * 3 + [1.0] * 3)


def walk(motions: list[F8]) -> F8:
    T = [np.eye(4)]
    for motion in motions:
        T.append(T[-1] @ motion)
    return np.array(T)


def test_the_correction_goes_into_the_guessed_motion() -> None:
    motion = se3_exp([0, 0, 0.1, 1.0, 0, 0])
    true = walk([motion] * 5)
    guessed = walk([motion, motion @ se3_exp([0.05, -0.1, 0.3, 0.8, -0.4, 0.1]), motion, motion, motion])
    covariance = np.array([TIGHT, WIDE, TIGHT, TIGHT, TIGHT])
    T, after = close_gap(guessed, covariance, true[-1], TIGHT)
    assert np.abs(T - true).max() < 2e-3
    np.testing.assert_array_equal(T[-1], true[-1])
    np.testing.assert_array_equal(T[0], guessed[0])
    assert np.sqrt(after[1].diagonal()).max() < 0.01, "the end tells the only motion that was not known"


def test_equal_doubts_share_the_correction() -> None:
    guessed = walk([pose(np.eye(3), [1.0, 0, 0])] * 4)
    end = pose(np.eye(3), [4.8, 0, 0])
    T, after = close_gap(guessed, np.array([WIDE] * 4), end, TIGHT)
    np.testing.assert_allclose(T[:, 0, 3], [0, 1.2, 2.4, 3.6, 4.8], atol=1e-6)
    np.testing.assert_allclose(after[:, 3, 3], 0.75, atol=1e-5)


def test_covariances_agree_with_drawn_errors() -> None:
    """Errors of the motions after the correction, over many draws, are as large as their covariances say."""
    rng = np.random.default_rng(0)
    small = np.diag([1e-5] * 3 + [1e-3] * 3)
    motion = se3_exp([0, 0, 0.2, 1.0, 0.1, 0])
    true, square = walk([motion] * 3), []
    for _ in range(300):
        steps = [motion @ se3_exp(rng.multivariate_normal(np.zeros(6), small)) for _ in range(3)]
        end = true[-1] @ se3_exp(rng.multivariate_normal(np.zeros(6), TIGHT))
        T, after = close_gap(walk(steps), np.array([small] * 3), end, TIGHT)
        error = se3_log(inverse(motion) @ inverse(T[:-1]) @ T[1:])
        square += [e @ np.linalg.solve(C, e) for e, C in zip(error, after, strict=True)]
    assert np.mean(square) == pytest.approx(6.0, rel=0.1)
