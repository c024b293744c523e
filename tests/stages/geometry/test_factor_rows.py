"""Rows of the graph: which loop and which fix became what."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.stages.geometry.factor_rows import (
    OUTSIDE,
    fix_rows,
    loop_verdicts,
    reason_counts,
    split_key,
    without_numbers,
)
from tests.stages.mapping import fixes_graph, graph_of, loops_of

T = np.tile(np.eye(4), (60, 1, 1))


def test_a_session_may_have_slashes_in_its_name() -> None:
    assert split_key("monday/run 2/17") == ("monday/run 2", 17)


def test_a_loop_has_the_verdict_of_its_factor_and_a_refused_one_has_none() -> None:
    loops = loops_of(T, [(0, 40), (1, 41), (2, 42)], [0.0] * 3)
    loops = Loops(**{**vars(loops), "accepted": np.array([True, False, True])})
    graph = graph_of(loops, ["used", "switched off: contradicts the rest of the graph"])
    assert loop_verdicts(loops, graph).tolist() == [
        "used",
        "",
        "switched off: contradicts the rest of the graph",
    ]
    assert loop_verdicts(loops, Graph.empty()).tolist() == ["", "", ""]
    assert loop_verdicts(Loops.empty(), graph).tolist() == []


def test_loops_of_two_sessions_with_the_same_scans_are_told_apart() -> None:
    loops = loops_of(T, [(0, 40), (0, 40)], [0.0, 0.0])
    loops = Loops(**{**vars(loops), "session_j": np.array(["a", "b"], object)})
    assert loop_verdicts(loops, graph_of(loops, ["wrong", "used"])).tolist() == ["wrong", "used"]


def test_fixes_keep_their_order_and_those_outside_the_scans_have_no_residual() -> None:
    positions = np.arange(9.0).reshape(3, 3)
    off = np.array([[3.0, 4.0, 9.0], [1.0, 0.0, 0.0], [np.nan] * 3])
    graph = Graph.concatenate(
        [
            fixes_graph(positions, off, ["used", OUTSIDE, "no fix"]),
            fixes_graph(positions[:1], off[:1], ["used"], "b"),
        ]
    )
    found = fix_rows(graph)
    assert list(found) == ["a", "b"]
    assert found["a"].horizontal_m[0] == 5.0
    assert np.isnan(found["a"].horizontal_m[1:]).all()
    assert found["a"].used.tolist() == [True, False, False]
    assert np.array_equal(found["a"].position_m, positions)
    assert len(found["b"]) == 1
    assert fix_rows(Graph.empty()) == {}


@pytest.mark.parametrize(
    ("reason", "want"),
    [
        ("overlap 0.31 is under 0.4", "overlap … is under …"),
        ("only 21% of the points find a partner", "only …% of the points find a partner"),
        ("chi-square 31 (3 sigma)", "chi-square … (… sigma)"),
        ("used", "used"),
        ("", ""),
    ],
)
def test_reasons_that_differ_in_numbers_only_are_one(reason: str, want: str) -> None:
    assert without_numbers(reason) == want


def test_reasons_are_counted_the_most_frequent_first() -> None:
    reasons = np.array(["b", "off by 2 m", "off by 3 m", "a"], object)
    assert list(reason_counts(reasons).items()) == [("off by … m", 2), ("a", 1), ("b", 1)]
