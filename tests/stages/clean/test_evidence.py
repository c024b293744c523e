"""Sequences of hits and free bins: cut into chunks they say the same as whole."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from scanloom.schemas.clean import BRICK_VOXELS, Rays
from scanloom.stages.clean.evidence import MOST, Evidence, all_bricks

BINS = st.lists(st.sampled_from("hf."), max_size=40)
"""h: met something, f: saw through, .: said nothing."""


def told(bins: list[str]) -> tuple[int, int, int, int]:
    """hits, before, between, after of one sequence, bin by bin."""
    hits = before = between = after = 0
    for each in bins:
        if each == "h":
            between, after, hits = between + (after if hits else 0), 0, hits + 1
        elif each == "f":
            before, after = (before, after + 1) if hits else (before + 1, after)
    return hits, before, between, after


def rays(bins: list[str], brick: int = 7) -> Rays:
    hits, before, between, after = (np.zeros((1, BRICK_VOXELS), np.uint8) for _ in range(4))
    hits[0, 5], before[0, 5], between[0, 5], after[0, 5] = told(bins)
    return Rays(
        brick=np.array([brick], np.int64), hits=hits, tracked=np.zeros_like(hits), before=before, between=between,
        after=after, first_ns=0, voxel_size_m=0.2, tile_size_m=50.0, frame="map",
    )  # fmt: skip


@settings(deadline=None)
@given(st.lists(BINS, min_size=1, max_size=6))
def test_chunks_add_up_to_the_whole(chunks: list[list[str]]) -> None:
    evidence = Evidence.of(np.array([3, 7], np.int64))
    for chunk in chunks:
        evidence.add(rays(chunk))
    whole = told([each for chunk in chunks for each in chunk])
    found = (evidence.hits, evidence.before, evidence.between, evidence.after)
    assert tuple(int(counts[1, 5]) for counts in found) == whole
    assert int(evidence.through[1, 5]) == sum(whole[1:])
    assert not any(counts[0].any() for counts in found)


def test_a_brick_that_is_not_asked_for_is_passed_over() -> None:
    evidence = Evidence.of(np.array([3], np.int64))
    evidence.add(rays(["h"], brick=9))
    assert not evidence.hits.any()


def test_counts_stop_at_their_limit() -> None:
    evidence = Evidence.of(np.array([7], np.int64))
    for _ in range(MOST // 250 + 2):
        evidence.add(rays(["f"] * 250))
    assert int(evidence.before[0, 5]) == MOST
    assert int(evidence.through[0, 5]) == MOST


def test_all_bricks_are_named_once_in_order() -> None:
    assert all_bricks(part.brick for part in (rays([], 9), rays([], 2), rays([], 9))).tolist() == [2, 9]
    assert len(all_bricks([])) == 0
