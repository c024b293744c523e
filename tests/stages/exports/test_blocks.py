"""Blocks of the export's axes: every row once, whatever the budget, and no memory kept by what is done."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as effort
from hypothesis import strategies as st

from scanloom.stages.exports.blocks import Grid, Pool, split, z_order

ROW = np.dtype([("number", "<i8"), ("weight", "u1")])


def rows(numbers: np.ndarray) -> np.ndarray:
    out = np.zeros(len(numbers), ROW)
    out["number"] = numbers
    return out


class Parts:
    """Three parts of a map whose rows lie in a few blocks, negative ones too; counts how often each is read."""

    def __init__(self, seed: int, n: int) -> None:
        rng = np.random.default_rng(seed)
        self.blocks = {name: rng.integers(-2, 2, (n, 2)) for name in "abc"}
        self.rows = {name: rows(np.arange(n) + 1000 * k) for k, name in enumerate("abc")}
        self.read: list[str] = []

    def load(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        self.read.append(name)
        return self.rows[name], self.blocks[name]

    @property
    def plan(self) -> dict[tuple[int, int], list[str]]:
        every = sorted({tuple(b) for blocks in self.blocks.values() for b in blocks.tolist()}, key=z_order)
        return {block: list("abc") for block in every}


@effort(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 60), budget=st.sampled_from([0, 300, 10**6]))
def test_every_row_comes_once_and_in_its_block(seed: int, n: int, budget: int) -> None:
    parts = Parts(seed, n)
    pool = Pool(parts.plan, parts.load, budget)
    seen = []
    for block in parts.plan:
        for piece in pool.take(block):
            for number in piece["number"].tolist():
                name = "abc"[number // 1000]
                assert tuple(parts.blocks[name][number % 1000]) == block
                seen.append(number)
    assert sorted(seen) == sorted(number for r in parts.rows.values() for number in r["number"].tolist())


def test_within_the_budget_parts_are_read_once() -> None:
    parts = Parts(1, 50)
    pool = Pool(parts.plan, parts.load, 10**6)
    for block in parts.plan:
        pool.take(block)
    assert sorted(parts.read) == ["a", "b", "c"]


def test_beyond_it_they_are_read_again() -> None:
    parts = Parts(1, 50)
    pool = Pool(parts.plan, parts.load, 50 * ROW.itemsize)
    for block in parts.plan:
        pool.take(block)
    assert len(parts.read) > 3


def test_pieces_share_no_memory() -> None:
    parts = Parts(2, 40)
    pieces = list(split(*parts.load("a")).values())
    assert len(pieces) > 3 and all(
        piece.base is None or piece.base.nbytes == piece.nbytes for piece in pieces
    )


def test_no_rows() -> None:
    assert split(rows(np.empty(0, np.int64)), np.empty((0, 2), np.int64)) == {}


def test_grid_lists_what_a_box_touches() -> None:
    grid = Grid(np.array([10.0, -10.0]), 20.0)
    found = grid.blocks(np.array([9.0, -10.0, 0.0]), np.array([30.0, 9.9, 5.0]))
    assert found == [(-1, 0), (0, 0), (1, 0)]


@pytest.mark.parametrize("corner", [(0, 0), (-4, 8), (-8, -8)])
def test_four_neighbours_follow_each_other(corner: tuple[int, int]) -> None:
    square = [(corner[0] + x, corner[1] + y) for x in range(4) for y in range(4)]
    codes = sorted(map(z_order, square))
    assert codes[-1] - codes[0] == 15
