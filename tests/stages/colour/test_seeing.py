"""Seeing: what stands before a surface hides it, however flat it is looked along; no surface is seen from behind."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.colour.seeing import Seen, visible
from scanloom.stages.colour.settings import Settings
from scanloom.stages.geometry.camera import rays
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


def looked(points: F8, normal: F8, **settings: float) -> Seen:
    return visible(Settings(**settings), MODEL, points, normal.astype(np.float32), STEP_M)


def seen(points: F8, normal: F8, least_cosine: float = 0.03, **settings: float) -> np.ndarray:
    """Which of the points (n, 3) the camera sees."""
    found = np.zeros(len(points), bool)
    found[looked(points, normal, least_cosine=least_cosine, **settings).rows] = True
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


def test_a_point_without_a_surface_is_not_seen_from_afar() -> None:
    away = np.array([19.9, 20.1])
    points = np.column_stack((2.0 * np.arange(2.0) - 1.0, np.zeros(2), away))
    points *= (away / np.linalg.norm(points, axis=1))[:, None]
    assert seen(points, np.zeros((2, 3))).tolist() == [True, False]
    assert seen(points, np.zeros((2, 3)), bare_m=20.2).all()
    assert seen(points, np.tile((0.0, 0.0, -1.0), (2, 1))).all()


@pytest.mark.parametrize("margin_px", [0.0, 2.0, 10.0])
def test_nothing_is_seen_beside_the_edge_of_the_picture(margin_px: float) -> None:
    model, inset = MODEL, margin_px + np.array([-0.01, 0.01])
    left = np.column_stack((inset - 0.5, np.full(2, model.cy_px)))
    right = np.column_stack((model.width_px - 0.5 - inset, np.full(2, model.cy_px)))
    top = np.column_stack((np.full(2, model.cx_px), inset - 0.5))
    bottom = np.column_stack((np.full(2, model.cx_px), model.height_px - 0.5 - inset))
    for pixels in (left, right, top, bottom):
        points = 10.0 * rays(model, pixels)
        found = [seen(one[None], np.array([[0.0, 0.0, -1.0]]), margin_px=margin_px)[0] for one in points]
        assert found == [False, True]


def test_what_is_seen_barely_is_not_seen_surely() -> None:
    road = ground()
    cosine = EYE_M / np.linalg.norm(road, axis=1)
    found = looked(road, np.tile((0.0, -1.0, 0.0), (len(road), 1)), least_cosine=0.06)
    assert np.array_equal(found.surely, cosine[found.rows] >= 0.12)
    assert 0.2 < found.surely.mean() < 0.9

    wall = np.array([[0.0, 0.0, 10.0]])
    for stands_out_m, seen_at_all, surely in ((0.04, True, True), (0.07, True, False), (0.13, False, False)):
        before = wall - (0.0, 0.0, 1.0) * np.array(stands_out_m)
        toward = np.array([0.0, 0.0, -1.0])
        found = looked(
            np.concatenate((wall, before)), np.tile(toward, (2, 1)), tolerance_m=0.1, alone=2.0, margin_px=0.0
        )
        assert (0 in found.rows) == seen_at_all
        assert (0 in found.rows[found.surely]) == surely
