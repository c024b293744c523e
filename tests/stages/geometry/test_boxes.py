"""Which points lie in which box, at every side."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.boxes import inside_boxes, near_boxes
from scanloom.stages.geometry.se3 import pose, so3_exp

BOX = np.array([[1.0, 0, 0, 10.0, 0, 1.0, 0, 5.0, 0, 0, 1.0, -2.0, 4.0, 2.0, 1.5]])


def number(x: float, y: float, z: float, inflate_m: float = 0.0, boxes: np.ndarray = BOX) -> int:
    at = (np.array([value], np.float32) for value in (x, y, z))
    return int(inside_boxes(*at, boxes, inflate_m)[0])


@pytest.mark.parametrize(
    ("x", "y", "z", "found"),
    [
        (10.0, 5.0, -1.0, 0), (12.0, 5.0, -1.0, 0), (12.01, 5.0, -1.0, -1), (7.99, 5.0, -1.0, -1),
        (10.0, 6.0, -1.0, 0), (10.0, 6.01, -1.0, -1), (10.0, 3.99, -1.0, -1),
        (10.0, 5.0, -2.0, 0), (10.0, 5.0, -2.01, -1), (10.0, 5.0, -0.5, 0), (10.0, 5.0, -0.49, -1),
    ],
)  # fmt: skip
def test_sides(x: float, y: float, z: float, found: int) -> None:
    assert number(x, y, z) == found


@pytest.mark.parametrize(
    ("x", "y", "z", "found"),
    [(12.29, 6.29, -1.0, 0), (12.31, 5.0, -1.0, -1), (10.0, 5.0, -0.21, 0), (10.0, 5.0, -0.19, -1), (10.0, 5.0, -2.01, -1)],
)  # fmt: skip
def test_boxes_grow_to_the_sides_and_upwards_but_not_into_the_ground(x: float, y: float, z: float, found: int) -> None:  # fmt: skip
    assert number(x, y, z, 0.3) == found


def test_turned_box() -> None:
    T = pose(so3_exp([0, 0, np.pi / 2]), [10.0, 5.0, -2.0])
    turned = np.array([[*T[:3].ravel(), 4.0, 2.0, 1.5]])
    assert number(10.0, 6.9, -1.0, boxes=turned) == 0
    assert number(11.9, 5.0, -1.0, boxes=turned) == -1


def test_the_first_of_several_boxes_and_none() -> None:
    assert number(10.0, 5.0, -1.0, boxes=np.concatenate((BOX, BOX))) == 0
    assert number(10.0, 5.0, -1.0, boxes=np.empty((0, 15))) == -1
    assert number(np.nan, 5.0, -1.0) == -1
    empty = np.empty(0, np.float32)
    assert len(inside_boxes(empty, empty, empty, BOX, 0.3)) == 0


def test_many_boxes_are_as_each_by_itself() -> None:
    rng = np.random.default_rng(2)
    boxes = np.array(
        [
            [*pose(so3_exp(rng.normal(size=3) * [0.02, 0.02, 2.0]), rng.uniform(-20, 20, 3) * [1, 1, 0.1])[:3].ravel(), *size]
            for size in rng.uniform(0.5, 6.0, (12, 3))
        ]
    )  # fmt: skip
    x, y, z = (rng.uniform(-25, 25, 9000) * scale for scale in (1.0, 1.0, 0.1))
    points = [each.astype(np.float32) for each in (x, y, z)]
    expected = np.full(9000, -1)
    for b in range(11, -1, -1):
        T = boxes[b, :12].reshape(3, 4)
        u, v, w = T[:, :3].T @ (np.array(points, float) - T[:, 3:])
        length, width, height = boxes[b, 12:]
        inside = (abs(u) <= length / 2 + 0.3) & (abs(v) <= width / 2 + 0.3) & (w >= 0.0) & (w <= height + 0.3)
        expected[inside] = b
    found = inside_boxes(*points, boxes, 0.3)
    assert np.array_equal(found, expected)
    assert (found >= 0).sum() > 100
    assert (near_boxes(*points, boxes, 0.3) >= (found >= 0)).all()
    assert near_boxes(*points, boxes, 0.3).mean() < 0.9
