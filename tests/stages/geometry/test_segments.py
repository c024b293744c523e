"""Connected things of small range images that can be read by eye."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.segments import STEP_M, STEP_PER_M, connected


def image(*rows: str) -> np.ndarray:
    """A letter is a range: a 10 m, b 20 m, c 30 m; a dot is nothing. The first row is the lowest."""
    ranges = {".": 0.0, "a": 10.0, "b": 20.0, "c": 30.0}
    return np.array([[ranges[letter] for letter in row] for row in rows], np.float32)


def things(*rows: str) -> list[list[int]]:
    number, count = connected(image(*rows))
    assert set(number.ravel().tolist()) - {-1} == set(range(count))
    return [[int(n) for n in row] for row in number]


def test_ranges_part_things() -> None:
    assert things("....aabb....", "....aabb....") == [[-1] * 4 + [0, 0, 1, 1] + [-1] * 4] * 2


def test_gaps_of_one_cell_are_bridged_and_wider_ones_are_not() -> None:
    assert things("...a.a..a...") == [[-1, -1, -1, 0, -1, 0, -1, -1, 1, -1, -1, -1]]
    assert things("....a....", ".........", "....a....")[2][4] == 0
    assert things("....a....", ".........", ".........", "....a....")[3][4] == 1


def test_what_lies_between_parts() -> None:
    assert things("...aba...") == [[-1, -1, -1, 0, 1, 2, -1, -1, -1]]
    assert things("....a....", "....b....", "....a....") == [[-1] * 4 + [k] + [-1] * 4 for k in (0, 1, 2)]


def test_columns_go_round_and_rows_do_not() -> None:
    assert things("a......a") == [[0, -1, -1, -1, -1, -1, -1, 0]]
    assert things(".a.....a") == [[-1, 0, -1, -1, -1, -1, -1, 0]]
    assert things("..a....a") == [[-1, -1, 0, -1, -1, -1, -1, 1]]
    assert things("...a....", "........", "........", "...a....")[3][3] == 1


def test_corners_touch() -> None:
    assert things("...a....", "....a...", ".....a..") == [
        [-1] * 3 + [0] + [-1] * 4, [-1] * 4 + [0] + [-1] * 3, [-1] * 5 + [0] + [-1] * 2,
    ]  # fmt: skip


@pytest.mark.parametrize("range_m", [5.0, 40.0])
def test_the_step_grows_with_range(range_m: float) -> None:
    step = STEP_M + STEP_PER_M * range_m
    for share, count in ((0.98, 1), (1.02, 2)):
        row = np.zeros((1, 9), np.float32)
        row[0, 4:6] = range_m, range_m + share * step
        assert connected(row)[1] == count


def test_nothing() -> None:
    number, count = connected(np.zeros((3, 8), np.float32))
    assert count == 0
    assert (number == -1).all()
    assert connected(np.ones((1, 1), np.float32))[1] == 1
