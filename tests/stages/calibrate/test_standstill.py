"""When a board stands still in images."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from benchmarks.board_scenes import model
from scanloom.stages.calibrate.standstill import Standstill, StandstillSettings, Watch, apart_px, standstills
from scanloom.stages.geometry.se3 import pose
from tests.stages.calibrate.test_image import BOARD, T_CAMERA_BOARD, drawn

SETTINGS = StandstillSettings(spacing_s=0.5, still_s=1.0)
S = 1_000_000_000
LENS = model(2)


def still(start_s: float, end_s: float, **at: float) -> Standstill:
    corners = {camera: np.array([[x, 0.0], [x + 9.0, 5.0]]) for camera, x in at.items()}
    return Standstill(round(start_s * S), round(end_s * S), corners)


class Seen(Watch):
    """A watch that has made up its mind."""

    def __init__(self, *found: Standstill) -> None:
        super().__init__("any", LENS, BOARD, SETTINGS)
        self._found = list(found)

    def standstills(self) -> list[Standstill]:
        return self._found


@pytest.fixture(scope="module")
def watch() -> Watch:
    """Two seconds here, two images on the way, two seconds there; two images a second."""
    watch = Watch("front", LENS, BOARD, SETTINGS)
    ways = [0.0, 0.04, 0.08, 0.12]
    places = [drawn(LENS, BOARD, T_CAMERA_BOARD @ pose(np.eye(3), [way, 0.0, 0.0])) for way in ways]
    rng = np.random.default_rng(0)
    for k in range(12):
        image = places[min(max(k - 4, 0), 3)] + rng.normal(0.0, 2.0, places[0].shape)
        assert watch.wants(k * S // 2)
        watch.look(k * S // 2, np.clip(image, 0, 255).astype(np.uint8))
    return watch


def test_a_board_that_is_carried_stands_twice(watch: Watch) -> None:
    found = watch.standstills()
    assert [(s.start_ns / S, s.end_ns / S) for s in found] == [(0.0, 2.0), (3.5, 5.5)]
    assert watch.images == watch.boards == 12
    assert [s.image_ns("front") / S for s in found] == [1.0, 4.5]
    assert found[0].image_ns("left") is None
    assert apart_px(found[0].corners["front"], found[1].corners["front"]) > 20


def test_images_that_come_too_fast_are_not_wanted(watch: Watch) -> None:
    assert not watch.wants(11 * S // 2 + S // 4)
    assert watch.wants(6 * S)


def test_nothing_is_seen_where_nothing_is() -> None:
    watch = Watch("front", LENS, BOARD, SETTINGS)
    for k in range(5):
        watch.look(k * S, np.full((LENS.height_px, LENS.width_px), 90, np.uint8))
    assert watch.images == 5 and watch.boards == 0 and not watch.standstills()


def test_what_two_cameras_saw_is_one_standstill() -> None:
    found = standstills([Seen(still(0, 3, a=0)), Seen(still(1, 4, b=0))], SETTINGS)
    assert [(s.start_ns, s.end_ns, set(s.corners)) for s in found] == [(1 * S, 3 * S, {"a", "b"})]


@pytest.mark.parametrize(("overlap_s", "places"), [(0.49, 2), (0.51, 1)])
def test_what_hardly_overlaps_is_two(overlap_s: float, places: int) -> None:
    found = standstills([Seen(still(0, 3, a=0)), Seen(still(3 - overlap_s, 6, b=0))], SETTINGS)
    assert len(found) == places


@pytest.mark.parametrize(("apart", "places"), [(2.9, 1), (3.1, 2)])
def test_of_the_same_place_the_longest_is_taken(apart: float, places: int) -> None:
    found = standstills([Seen(still(0, 2, a=0), still(3, 6, a=apart))], SETTINGS)
    assert len(found) == places
    assert found[-1].length_ns == 3 * S


def test_corners_in_another_order_are_the_same() -> None:
    corners = np.random.default_rng(0).uniform(0, 900, (35, 2))
    assert apart_px(corners, corners[::-1]) == 0.0
    assert apart_px(corners, corners + np.array([3.0, 4.0])) == pytest.approx(5.0, abs=1e-6)


def test_bounds_of_settings() -> None:
    with pytest.raises(ValidationError, match="still_px"):
        StandstillSettings(still_px=0.0)
