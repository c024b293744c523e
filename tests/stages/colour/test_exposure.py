"""Exposure, fall-off, haze and tint come out of views that share points; what disagrees is outvoted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanloom.stages.colour.exposure import RINGS, equalised
from scanloom.stages.colour.looking import CELLS_ACROSS, CELLS_DOWN
from scanloom.stages.colour.own import LEAST_IMAGES, on_own_vehicle
from scanloom.stages.colour.views import Gathered, Views, alone, off_consensus

IMAGES, CAMERAS, POINTS = 12, 2, 1500


def views(seed: int = 0, wrong: float = 0.0) -> tuple[Views, np.ndarray]:
    """Views of points that each image sees by chance, and the true light (n, 3), logarithms, of each."""
    rng = np.random.default_rng(seed)
    point, image = np.nonzero(rng.random((POINTS, IMAGES)) < 0.4)
    n = len(point)
    camera, ring, away = image % CAMERAS, rng.integers(0, RINGS, n), rng.uniform(3.0, 40.0, n)
    paint = rng.normal(-2.0, 0.6, (POINTS, 1)) + rng.normal(0.0, 0.2, (POINTS, 3))
    gain, falloff = rng.normal(0.0, 0.3, IMAGES), np.linspace(0.0, -0.4, RINGS)
    tint = np.array([[0.05, 0.0, -0.05], [-0.05, 0.0, 0.05]])
    light = paint[point] + (gain[image] + falloff[ring] + 0.004 * away)[:, None] + tint[camera]
    light += rng.normal(0.0, 0.03, (n, 3))
    light[rng.random(n) < wrong] = 0.0
    numbers = (np.asarray(x, np.int32) for x in (point, image, camera, image * 0, ring))
    made = Views(
        *numbers, away.astype(np.float32), light.astype(np.float32), np.ones(n, np.float32), np.zeros(n, bool)
    )
    return made, paint[point]


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_light_of_a_point_is_the_same_in_all_images(wrong: float) -> None:
    seen, paint = views(wrong=wrong)
    off = equalised(seen, IMAGES, CAMERAS) - paint
    off -= np.median(off, axis=0)
    assert 0.01 < np.median(np.abs(off)) < 0.035
    by_image = [np.median(off[seen.image == k]) for k in range(IMAGES)]
    by_ring = [np.median(off[seen.ring == k]) for k in range(RINGS)]
    assert np.abs(by_image).max() < 0.03
    assert np.abs(by_ring).max() < 0.03
    assert abs(np.polyfit(seen.away, off.mean(axis=1), 1)[0]) < 1e-3 + wrong * 0.1
    assert all(np.abs(np.median(off[seen.camera == k], axis=0)).max() < 0.03 for k in range(CAMERAS))


def test_an_image_that_shares_nothing_is_taken_to_be_as_bright_as_the_others() -> None:
    seen, _ = views()
    alone = seen.image == 5
    lonely = seen.point.copy()
    lonely[alone] = POINTS + np.arange(alone.sum())
    parts = replace(seen, point=lonely)
    gathered = Gathered()
    gathered.add(parts)
    ordered = gathered.ordered()
    light = equalised(ordered, IMAGES, CAMERAS)
    assert np.median(light[ordered.image == 5]) == pytest.approx(np.median(light), abs=0.15)


def test_views_are_ordered_by_point_and_by_image_within() -> None:
    seen, _ = views()
    gathered = Gathered()
    for image in range(IMAGES):
        gathered.add(seen.take(seen.image == image))
    ordered = gathered.ordered()
    assert len(ordered) == len(seen)
    assert np.array_equal(ordered.point, seen.point)
    assert np.array_equal(ordered.image, seen.image)
    assert np.array_equal(np.diff(ordered.starts), np.unique(seen.point, return_counts=True)[1])


def test_off_is_the_largest_difference_to_the_weighted_median() -> None:
    light = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0, -3], [5, 5, 5]], np.float32)
    point = np.array([0, 0, 0, 1], np.int32)
    zeros = np.zeros(4, np.int32)
    ones = np.ones(4, np.float32)
    same = Views(point, zeros, zeros, zeros, zeros, ones, light, ones, np.zeros(4, bool))
    assert off_consensus(same, light) == pytest.approx([0.0, 0.1, 3.0, 0.0])
    heavy = np.array([1, 1, 100, 1], np.float32)
    assert off_consensus(replace(same, weight=heavy), light) == pytest.approx([3.0, 3.0, 0.0, 0.0])
    assert alone(same).tolist() == [False, False, False, True]


def hood(images: int) -> tuple[Views, np.ndarray]:
    """Each point is seen by five images; one view of every second point lies in a cell that says something else."""
    points = 40 * images
    point = np.repeat(np.arange(points), 5).astype(np.int32)
    image = (np.repeat(np.arange(points) % images, 5) + np.tile(np.arange(5), points)).astype(np.int32) % max(
        images, 5
    )
    first = (np.arange(len(point)) % 5 == 0) & (point % 2 == 0)
    cell = np.where(first, (CELLS_DOWN - 1) * CELLS_ACROSS + 10, 3 * CELLS_ACROSS + 3).astype(np.int32)
    image[first] = (point[first] // 2) % images
    off = np.where(first, 1.0, 0.05).astype(np.float32)
    zeros, ones = np.zeros(len(point), np.int32), np.ones(len(point), np.float32)
    light = np.zeros((len(point), 3), np.float32)
    return Views(point, image, zeros, cell, zeros, ones, light, ones, ones > 0), off


def test_cells_that_always_disagree_show_the_own_vehicle() -> None:
    seen, off = hood(LEAST_IMAGES)
    own = on_own_vehicle(seen, off, 1, 0.5)
    assert np.array_equal(own, off > 0.5)
    assert own.sum() == 20 * LEAST_IMAGES


def test_few_images_say_nothing_of_the_own_vehicle() -> None:
    seen, off = hood(LEAST_IMAGES - 1)
    assert not on_own_vehicle(seen, off, 1, 0.5).any()
