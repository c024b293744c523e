"""Precision and recall by hand."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.evaluation.precision import curve

POSITIVE = np.array([True, True, True, False, True])
SCORE = np.array([0.1, 0.2, 0.4, 0.3, np.inf])
RIGHT = np.array([True, True, True, False, False])


def test_a_curve_by_hand() -> None:
    line = curve(SCORE, RIGHT, POSITIVE)
    np.testing.assert_allclose(line.score, [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(line.precision, [1, 1, 2 / 3, 3 / 4])
    np.testing.assert_allclose(line.recall, [1 / 4, 2 / 4, 2 / 4, 3 / 4])
    assert line.recall_at(1.0) == 0.5
    assert line.recall_at(0.75) == 0.75
    assert line.recall_at(0.76) == 0.5
    assert line.f1_max() == pytest.approx(0.75)
    assert line.extended_precision() == pytest.approx((1 + 0.5) / 2)


def test_equal_scores_are_accepted_together() -> None:
    line = curve(np.array([0.1, 0.1]), np.array([True, False]), np.array([True, True]))
    assert (line.precision.tolist(), line.recall.tolist()) == ([0.5], [0.5])
    assert line.recall_at(1.0) == 0.0
    assert line.extended_precision() == 0.25


def test_an_answer_to_what_has_none_is_false() -> None:
    assert curve(np.array([0.1]), np.array([True]), np.array([False])).precision.tolist() == [0.0]


def test_no_answers() -> None:
    line = curve(np.array([np.inf]), np.array([False]), np.array([True]))
    assert (line.recall_at(0.5), line.f1_max(), line.extended_precision()) == (0.0, 0.0, 0.0)
    assert len(curve(np.empty(0), np.empty(0, bool), np.empty(0, bool)).score) == 0
