"""The protocol of the search's benchmark, on paths and answers by hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.places_search import METHODS, admitted, answers, judged, pooled, revisits
from benchmarks.places_worlds import KINDS, SEEDS, simulated
from scanloom.stages.geometry.se3 import pose, so3_exp
from scanloom.stages.loops.candidates import Track
from scanloom.stages.loops.position import Whereabouts
from scanloom.stages.loops.scan_context import contexts
from scanloom.stages.loops.search import Looks, Matches

SECOND_NS = 1_000_000_000


def heading(degrees: float) -> np.ndarray:
    return so3_exp([0.0, 0.0, np.radians(degrees)])


def path(second: float, beside_m: float) -> np.ndarray:
    """100 m along x, then the same again with another heading, `beside_m` to the left."""
    x = np.arange(0.0, 100.0)
    first = [pose(heading(0.0), [v, 0.0, 0.0]) for v in x]
    return np.array(first + [pose(heading(second), [v, beside_m, 0.0]) for v in x])


def track(T: np.ndarray) -> Track:
    """Places look the same where they are the same along x."""
    rng = np.random.default_rng(0)
    kinds = rng.uniform(1, 9, (100, 20, 60)) * (rng.random((100, 20, 60)) < 0.4)
    seen = contexts(np.stack([kinds[np.round(T[:, 0, 3]).astype(int)]] * 3).astype(np.float32))
    n = len(T)
    travelled = np.arange(n, dtype=float)
    where = Whereabouts(T[:, :3, 3], np.zeros((n, 6, 6)), travelled)
    every = np.arange(n)
    return Track("a", every, every * SECOND_NS, T, travelled, where, Looks(seen, seen, travelled))


@pytest.mark.parametrize(
    ("turn_deg", "beside_m", "same", "opposite"),
    [
        (0, 3.9, 100, 0),
        (89, 3.9, 100, 0),
        (91, 3.9, 0, 100),
        (180, 3.9, 0, 100),
        (0, 4.1, 0, 0),
        (180, 4.1, 0, 0),
    ],
)
def test_revisits_have_a_direction(turn_deg: float, beside_m: float, same: int, opposite: int) -> None:
    T = path(turn_deg, beside_m)
    first = np.where(np.arange(200) < 100, 0, 100)
    found = revisits(T, first, 4.0)
    assert (int(found.same.sum()), int(found.opposite.sum())) == (same, opposite)
    positive, asked = found.of("opposite")
    assert positive.sum() == opposite
    assert asked.sum() == 200 - same


def test_a_place_passed_both_ways_is_one_of_the_same_direction() -> None:
    T = np.concatenate((path(180.0, 1.0), path(180.0, 1.0)[:100]))
    first = np.where(np.arange(300) < 200, 0, 200)
    found = revisits(T, first, 4.0)
    assert found.same[200:].all()
    assert not found.opposite.any()


def test_what_is_admitted() -> None:
    limits = admitted(track(path(0.0, 1.0)))
    assert limits[49] == 0
    assert limits[150] == 101


def test_answers_are_judged_by_distance() -> None:
    T = path(0.0, 1.0)
    place, score = np.full(200, -1), np.full(200, np.inf)
    place[100:110], score[100:110] = np.arange(10), 0.1
    place[110], score[110] = 50, 0.2
    nothing = np.full(200, np.nan)
    matches = Matches(place, np.zeros(200, np.int64), nothing, nothing, nothing, score)
    part = judged(matches, T, np.where(np.arange(200) < 100, 0, 100), 4.0)
    line = part.curve("same")
    assert line.recall_at(1.0) == pytest.approx(0.10)
    assert line.precision[-1] == pytest.approx(10 / 11)
    twice = pooled([part, part]).curve("all")
    assert twice.recall_at(1.0) == pytest.approx(0.10)
    assert part.curve("opposite").recall_at(0.5) == 0.0


def test_every_method_finds_places_that_look_like_no_other() -> None:
    t = track(path(0.0, 1.0))
    for method in METHODS:
        found, seconds = answers(method, t, admitted(t))
        assert seconds >= 0
        line = judged(found, t.T_odom_lidar, admitted(t), 4.0).curve("same")
        assert line.recall_at(1.0) == pytest.approx(1.0, abs=0.02)


def test_three_seeds_of_every_kind() -> None:
    assert len(SEEDS) == 3
    names = [drive.name for kind in KINDS for drive in simulated(kind)]
    assert len(set(names)) == 6
