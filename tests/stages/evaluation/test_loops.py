"""Loops in use and the search for them: what is right, what is found, and what is neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanloom.schemas.pose_graph import Graph
from scanloom.stages.evaluation.search import precision_recall
from tests.stages.evaluation.driving import ARC, LAP, figures_of, laps
from tests.stages.mapping import (
    graph_of,
    loops_of,
    odometry_of,
)


def test_only_loops_that_the_graph_uses_are_accepted() -> None:
    T = laps()
    loops = loops_of(T, [(10, 513), (200, 703), (400, 903)], [0.0, 0.0, 3.0])
    figures = figures_of(T=T, loops=loops, graph=graph_of(loops, ["used", "used", "switched off: …"]))
    assert (figures["loops.candidates"], figures["loops.verified"], figures["loops.accepted"]) == (3, 3, 2)
    assert figures["loops.precision"] == 1.0
    assert figures["loops.verified_precision"] == pytest.approx(2 / 3)
    everything = figures_of(T=T, loops=loops)
    assert everything["loops.accepted"] == 3
    assert everything["loops.precision"] == pytest.approx(2 / 3)
    nothing = figures_of(T=T, loops=loops, graph=Graph.empty())
    assert nothing["loops.accepted"] == 0
    assert "loops.precision" not in nothing
    assert nothing["loops.recall"] == 0.0


def test_only_keyframes_that_come_back_count_for_recall() -> None:
    T = laps()
    loops = loops_of(T, [(10, 513)], [0.0])
    every = figures_of(T=T, loops=loops)["loops.recall"]
    sparse = replace(odometry_of(T), keyframe=np.arange(1000) % 10 == 3)
    few = figures_of(T=T, loops=loops, odometry=sparse)["loops.recall"]
    assert every == pytest.approx(21 / 499, rel=0.02)  # 503 to 999 come back, and two scans around the start
    assert few == pytest.approx(3 / 50, rel=0.05)


@pytest.mark.parametrize(("beside_m", "recall"), [(3.9, 1.0), (4.1, None)])
def test_a_place_is_the_same_within_four_metres(beside_m: float, recall: float | None) -> None:
    """The second pass is driven beside the first, and closed at every tenth scan."""
    T = np.concatenate([laps(ARC), laps(ARC, beside_m)])
    closed = np.arange(5, ARC, 10)
    loops = loops_of(T, [(int(k), ARC + int(k)) for k in closed], [0.0] * len(closed))
    assert figures_of(T=T, loops=loops).get("loops.recall") == recall


def test_no_loops_and_nothing_to_find_give_counts_alone() -> None:
    figures = figures_of(T=laps(100))
    assert figures["loops.accepted"] == figures["loops.candidates"] == 0
    assert not [name for name in figures if "precision" in name or "recall" in name or "search" in name]


# --- the search alone ---


def test_precision_and_recall_over_thresholds_by_hand() -> None:
    distance, right = np.array([0.3, 0.1, 0.2, 0.4]), np.array([False, True, True, True])
    curve = precision_recall(distance, right, np.array([0.1, 0.1, 0.2, np.inf]))
    assert curve.precision.tolist() == [1.0, 1.0, 2 / 3, 3 / 4]
    assert curve.recall.tolist() == [0.5, 0.75, 0.75, 0.75]
    assert curve.recall_at(1.0) == 0.75
    assert curve.f1_max() == pytest.approx(6 / 7)
    assert curve.extended_precision() == pytest.approx(0.875)


def test_candidates_of_one_distance_come_together() -> None:
    curve = precision_recall(np.array([0.2, 0.2]), np.array([True, False]), np.array([0.2]))
    assert curve.precision.tolist() == [0.5]
    assert curve.recall_at(1.0) == 0.0


def test_a_candidate_is_right_within_the_radius_and_wrong_beyond() -> None:
    T = np.concatenate([laps(ARC), laps(ARC, 4.5)])
    pairs = [(int(k), ARC + int(k)) for k in range(5, ARC, 10)]
    loops = loops_of(T, pairs, [0.0] * len(pairs))
    figures = figures_of(T=T, loops=loops)
    assert "loops.search_r4_f1_max" not in figures  # nothing comes within four metres
    for radius in (5, 10):
        assert figures[f"loops.search_r{radius}_f1_max"] == pytest.approx(1.0, abs=0.01)
        assert figures[f"loops.search_r{radius}_recall_at_p1"] == pytest.approx(1.0, abs=0.02)


def test_look_alike_places_cost_precision_and_unseen_ones_recall() -> None:
    T = laps()
    pairs = [(int(k), LAP + int(k)) for k in range(5, 300, 10)]
    wrong = [(int(k), LAP + 150 + int(k)) for k in range(5, 100, 10)]
    loops = loops_of(T, pairs + wrong, [0.0] * 40)
    distance = np.concatenate((np.linspace(0.1, 0.2, 30), np.full(10, 0.15)))
    figures = figures_of(T=T, loops=replace(loops, descriptor_distance=distance))
    assert figures["loops.search_r4_recall_at_p1"] == pytest.approx(0.3, abs=0.03)  # half of 300 of 500
    assert figures["loops.search_r4_extended_precision"] == pytest.approx(0.65, abs=0.02)
    assert figures["loops.search_r4_f1_max"] == pytest.approx(2 * 0.75 * 0.6 / 1.35, abs=0.03)
    by_position = replace(loops, descriptor_distance=np.full(40, np.nan))
    assert not [name for name in figures_of(T=T, loops=by_position) if "search" in name]
