"""The three stages of the search: trees against brute force, neighbours in both directions, segments against accidents."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.loops.scan_context import Contexts, contexts, descriptor_distance
from scanloom.stages.loops.search import Forest, Looks, SearchSettings, search

F4 = np.ndarray


def places(count: int, seed: int = 0) -> F4:
    """Descriptors (n, 20, 60) of places that differ."""
    rng = np.random.default_rng(seed)
    heights = rng.uniform(0.5, 12, (count, 20, 60)) * (rng.random((count, 20, 60)) < 0.4)
    return heights.astype(np.float32)


def looks(descriptor: F4, segment: F4 | None = None, step_m: float = 2.0) -> Looks:
    def views(d: F4) -> Contexts:
        return contexts(d[None])

    return Looks(
        views(descriptor),
        views(descriptor if segment is None else segment),
        step_m * np.arange(len(descriptor)),
    )


def every(count: int) -> np.ndarray:
    return np.arange(count)


# ------------------------------------------------------------------------------------------------------- ring-key trees


@pytest.mark.parametrize("period", [1, 7, 50, 1000])
def test_trees_find_what_brute_force_finds(period: int) -> None:
    rng = np.random.default_rng(3)
    keys, asked = rng.normal(size=(333, 20)).astype(np.float32), rng.normal(size=(60, 20)).astype(np.float32)
    first = rng.integers(0, 334, 60)
    first[:4] = 0, 1, 50, 333
    found = Forest(keys, period).nearest(asked, first, 10)
    for row, query, m in zip(found, asked, first, strict=True):
        wanted = np.argsort(np.linalg.norm(keys[:m].astype(float) - query, axis=1), kind="stable")[:10]
        assert row[: len(wanted)].tolist() == wanted.tolist()
        assert (row[len(wanted) :] == -1).all()


def test_work_grows_slower_than_the_number_of_keys() -> None:
    """Each query asks a logarithm of trees and compares less than a period of keys one by one."""
    keys = np.zeros((6400, 20), np.float32)
    keys[:, 0] = np.arange(6400)
    forest = Forest(keys, 50)
    forest.nearest(keys[:1], np.array([6399]), 5)
    assert len(forest._trees) <= 7
    assert sum(length for _, length in forest._trees) == 127


# -------------------------------------------------------------------------------------------------------------- distances


def test_distance_of_a_place_to_itself_turned() -> None:
    (d,) = places(1)
    for shift in (0, 1, 29, 59):
        distance, heading = descriptor_distance(d, np.roll(d, -shift, axis=1), 0.05)
        assert distance == pytest.approx(0.0, abs=2e-4)
        assert heading == pytest.approx((shift * np.radians(6) + np.pi) % (2 * np.pi) - np.pi)


def test_distance_as_the_formula_says() -> None:
    a, b = places(2)
    u, v = (x / np.maximum(np.linalg.norm(x, axis=0), 1e-9) for x in (a, b))
    wanted = []
    for shift in range(60):
        cosine = (u * np.roll(v, shift, axis=1)).sum(axis=0)
        wanted.append(1 - cosine[cosine > 0].mean())
    assert descriptor_distance(a, b)[0] == pytest.approx(min(wanted), abs=3e-4)


@pytest.mark.parametrize(("columns", "distance"), [(12, 0.0), (11, 1.0)])
def test_too_few_common_columns_say_nothing(columns: int, distance: float) -> None:
    d = np.zeros((20, 60), np.float32)
    d[4, :columns] = 3.0
    assert descriptor_distance(d, d)[0] == pytest.approx(distance, abs=1e-6)


def test_empty_scans_are_unlike_everything() -> None:
    empty = np.zeros((20, 60), np.float32)
    assert descriptor_distance(empty, empty)[0] == 1.0
    assert descriptor_distance(empty, places(1)[0])[0] == 1.0


# ------------------------------------------------------------------------------------------------------------ three stages


def drives(reverse: bool) -> tuple[Looks, Looks]:
    """Ten places, and the same seen again with a little noise, from the last to the first when `reverse`."""
    there = places(10)
    again = there + np.random.default_rng(9).normal(0, 0.2, there.shape).astype(np.float32) * (there > 0)
    return looks(there), looks(again[::-1] if reverse else again)


@pytest.mark.parametrize("reverse", [False, True])
def test_neighbours_speak_for_a_place_in_both_directions(reverse: bool) -> None:
    old, new = drives(reverse)
    found = search(SearchSettings(), old, new, every(10), np.full(10, 10))
    wanted = every(10)[::-1] if reverse else every(10)
    np.testing.assert_array_equal(found.place, wanted)
    assert found.temporal.max() < 0.05
    np.testing.assert_array_equal(found.score, found.distance)
    assert {found.source(k) for k in range(10)} == {"temporal"}


def accident(alike: bool) -> tuple[Looks, Looks]:
    """One place among others looks like place 4 of the first drive; its segments do, too, when `alike`."""
    there, other = places(10), places(10, seed=5)
    other[6] = there[4]
    segment = other.copy()
    segment[6] = there[4] if alike else places(1, seed=8)[0]
    return looks(there), looks(other, segment)


def test_a_place_that_looks_alike_by_accident_is_betrayed_by_its_segments() -> None:
    old, new = accident(alike=False)
    found = search(SearchSettings(), old, new, every(10), np.full(10, 10))
    assert found.distance[6] == pytest.approx(0.0, abs=2e-4)
    assert found.temporal[6] > 0.25
    assert found.segment[6] > 0.3
    assert found.score[6] == pytest.approx(found.temporal[6] - 0.05)


def test_segments_that_are_alike_outweigh_the_neighbours() -> None:
    old, new = accident(alike=True)
    found = search(SearchSettings(), old, new, every(10), np.full(10, 10))
    assert found.segment[6] <= 0.3
    assert found.score[6] == found.distance[6]
    assert found.source(6) == "segments"


def test_segments_are_asked_only_where_neighbours_are_in_doubt() -> None:
    old, new = drives(reverse=False)
    found = search(SearchSettings(), old, new, every(10), np.full(10, 10))
    assert np.isnan(found.segment).all()


def test_the_view_from_the_lane_beside_is_searched_for_as_well() -> None:
    there, other = places(10), places(10, seed=5)
    two = np.stack((other, there))
    new = Looks(contexts(two), contexts(two), 2.0 * np.arange(10))
    found = search(SearchSettings(), looks(there), new, every(10), np.full(10, 10))
    np.testing.assert_array_equal(found.place, every(10))
    assert found.score.max() < 0.01


def test_recent_places_are_no_matches() -> None:
    old, new = drives(reverse=False)
    found = search(SearchSettings(), old, new, every(10), np.maximum(every(10) - 4, 0))
    assert (found.place < np.maximum(every(10) - 4, 1)).all()
    assert (found.place[:5] == -1).all()
    assert np.isinf(found.score[:5]).all()


def test_what_is_ruled_out_is_no_match_whatever_it_looks_like() -> None:
    old, new = drives(reverse=False)
    found = search(SearchSettings(), old, new, every(10), np.full(10, 10), lambda i, j: np.asarray(i == j))
    assert (found.place != every(10)).all()


def test_nothing_to_search_for_or_in() -> None:
    old, new = drives(reverse=False)
    nothing = looks(places(0))
    assert len(search(SearchSettings(), old, nothing, every(0), every(0)).place) == 0
    assert (search(SearchSettings(), nothing, new, every(10), np.zeros(10, np.int64)).place == -1).all()
    one = search(SearchSettings(), looks(places(1)), looks(places(1)), every(1), np.ones(1, np.int64))
    assert one.temporal[0] < 0.05 or one.source(0) == "segments"
