"""Seeing: what stands before a surface hides it, however flat it is looked along; no surface is seen from behind."""

from __future__ import annotations

import numpy as np

from scanloom.stages.colour.seeing import visible
from scanloom.stages.geometry.se3 import F8
from tests.stages.colour.scene import MODEL

EYE_M, CAR_M, CAR_HALF_M, CAR_HIGH_M = 1.6, 12.0, 2.0, 1.0
"""Height of the camera above the road; distance, half width and height of what stands on it."""
STEP_M = 0.1


def ground() -> F8:
    """Points (n, 3) of a road in the camera's axes: right, down, ahead."""
    right, ahead = (a.ravel() for a in np.meshgrid(np.arange(-6, 6, STEP_M), np.arange(4, 30, STEP_M)))
    return np.column_stack((right, np.full(len(right), EYE_M), ahead))


def car() -> F8:
    """Points (n, 3) of its back."""
    right, up = (
        a.ravel() for a in np.meshgrid(np.arange(-CAR_HALF_M, CAR_HALF_M, STEP_M), np.arange(0.05, CAR_HIGH_M, STEP_M))
    )  # fmt: skip
    return np.column_stack((right, EYE_M - up, np.full(len(right), CAR_M)))


def seen(points: F8, normal: F8, least_cosine: float = 0.03) -> np.ndarray:
    """Which of the points (n, 3) the camera sees."""
    found = np.zeros(len(points), bool)
    found[visible(MODEL, points, normal.astype(np.float32), STEP_M, 2.0, 0.12, least_cosine)[2]] = True
    return found


def test_what_stands_on_a_road_hides_the_road_behind_it() -> None:
    road, back = ground(), car()
    points = np.concatenate((road, back))
    normal = np.concatenate(
        (np.tile((0.0, -1.0, 0.0), (len(road), 1)), np.tile((0.0, 0.0, -1.0), (len(back), 1)))
    )
    found = seen(points, normal)[: len(road)]
    right, ahead = np.abs(road[:, 0]), road[:, 2]
    in_view = np.abs(road[:, 0]) * MODEL.fx_px < (MODEL.width_px / 2 - 2) * ahead
    behind = (ahead > CAR_M + 1.5) & (right < CAR_HALF_M / CAR_M * ahead - 0.2)
    assert behind.sum() > 4000
    assert not found[behind].any()
    clear = in_view & (EYE_M / ahead * MODEL.fy_px < MODEL.height_px / 2 - 2) & (
        (ahead < CAR_M - 1.5) | (right > CAR_HALF_M / CAR_M * ahead + 0.5)
    )  # fmt: skip
    assert clear.sum() > 5000
    assert found[clear].all(), "a road that is looked along does not hide itself"


def test_a_surface_is_not_seen_from_behind() -> None:
    right, ahead = (a.ravel() for a in np.meshgrid(np.arange(-1, 1, STEP_M), np.arange(3, 7, STEP_M)))
    for height_m, side in ((0.8, -1.0), (-0.8, 1.0)):
        roof = np.column_stack((right, np.full(len(right), height_m), ahead))
        facing = np.tile((0.0, side, 0.0), (len(roof), 1))
        assert seen(roof, facing).all()
        assert not seen(roof, -facing).any()
        assert seen(roof, 0.0 * facing).any(), "without a normal nothing is known of its side"


def test_a_surface_that_is_looked_along_too_flatly_is_not_seen() -> None:
    road = ground()
    normal = np.tile((0.0, -1.0, 0.0), (len(road), 1))
    cosine = EYE_M / np.linalg.norm(road, axis=1)
    inside = (np.abs(road[:, 0]) < 2.0) & (road[:, 2] > 6.0)
    found = seen(road, normal, least_cosine=0.1)
    assert np.array_equal(found[inside], (cosine > 0.1)[inside])
