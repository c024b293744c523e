"""AUC, and how pairs are judged."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.pairs import Judged, Places, auc, judged_pairs, scores
from scanloom.stages.geometry.se3 import pose
from tests.worlds import observe, street


def test_auc_counts_ordered_pairs_and_half_of_ties() -> None:
    assert auc(np.array([3.0, 4.0]), np.array([1.0, 2.0])) == 1.0
    assert auc(np.array([1.0, 2.0]), np.array([3.0, 4.0])) == 0.0
    assert auc(np.array([1.0, 3.0]), np.array([2.0, 2.0])) == 0.5
    assert auc(np.array([2.0, 2.0, 3.0]), np.array([2.0, 1.0])) == pytest.approx(5 / 6)


def test_infinite_indicators_are_the_worst() -> None:
    names = ("d", "d_unscaled", "e1", "e2", "e3", "rmse", "inlier_ratio", "least_p")
    good = Judged(True, dict.fromkeys(names, 0.1), True)
    bad = Judged(False, dict.fromkeys(names, float("nan")), False)
    said = {score.name: score.value for score in scores({"town": [good, bad]})}
    assert said["auc_e1"] == 1.0
    assert (said["matching"], said["non_matching"], said["registered_right"]) == (1, 1, 1.0)


@pytest.fixture(scope="module")
def places() -> Places:
    world, rng = street(2), np.random.default_rng(1)
    T = np.array([pose(np.eye(3), [2.0 * k, 0.0, 0.0]) for k in range(24)])
    points = [observe(world, pose_k, rng=rng).points().astype(float) for pose_k in T]
    return Places([p[::3] for p in points], [p[::12] for p in points], T)


def test_pairs_of_a_street_register_and_are_told_apart(places: Places) -> None:
    pairs = list(judged_pairs(places, 30, seed=0))
    assert sum(p.matching for p in pairs) == 30
    assert sum(not p.matching for p in pairs) == 30
    matching = [p for p in pairs if p.matching]
    assert np.mean([p.right for p in matching]) > 0.6
    assert not any(p.right for p in pairs if not p.matching)
    said = {score.name: score.value for score in scores({"street": pairs})}
    assert said["auc_e1"] > 0.8


def test_the_same_seed_gives_the_same_pairs(places: Places) -> None:
    first, again = (list(judged_pairs(places, 4, seed=3)) for _ in range(2))
    other = list(judged_pairs(places, 4, seed=4))
    assert first == again
    assert first != other
