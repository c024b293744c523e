"""A framed image tells of each cell's neighbours what the image tells, round the seam and at its edges."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scanloom.stages.denoise.frame import BESIDE, Frame, places_from
from scanloom.stages.geometry.range_image import ImageSettings, RangeImage, range_image

F4 = NDArray[np.float32]


def framed(points: int, seed: int) -> tuple[RangeImage, Frame, list[F4]]:
    rng = np.random.default_rng(seed)
    x, y, z = (rng.normal(0.0, s, points).astype(np.float32) for s in (20.0, 20.0, 2.0))
    if points > 10:
        x[3], y[4], z[5] = np.nan, np.inf, np.nan
        x[6] = y[6] = z[6] = 0.0
    every = np.ones(points, np.bool_)
    image = range_image(ImageSettings(), x, y, z, every, every)
    return image, Frame.of(image, x, y, z), [x, y, z]


@pytest.mark.parametrize("points", [0, 1, 50, 20_000])
def test_neighbours_are_those_of_the_image(points: int) -> None:
    image, frame, (x, y, z) = framed(points, points)
    rows, columns = image.point.shape
    np.testing.assert_array_equal(frame.place >= 0, image.cell >= 0)
    drawn = np.flatnonzero(image.cell >= 0)
    v, u = np.divmod(image.cell[drawn], columns)
    for i in (-1, 0, 1):
        for j in range(-BESIDE, BESIDE + 1):
            k = frame.place[drawn] + i * frame.stride + j
            inside = (v + i >= 0) & (v + i < rows)
            there = np.clip(v + i, 0, rows - 1), (u + j) % columns
            seen = np.where(image.point[there] >= 0, image.range_m[there], np.inf)
            np.testing.assert_array_equal(frame.range_m[k], np.where(inside, seen, np.nan))
            np.testing.assert_array_equal(frame.point[k], np.where(inside, image.point[there], -1))
    r = np.sqrt(x[drawn] ** 2 + y[drawn] ** 2 + z[drawn] ** 2)
    np.testing.assert_allclose(frame.away_m[drawn], r, rtol=1e-6)


def test_points_seen_from_their_own_place_lie_in_their_own_cells() -> None:
    _, frame, (x, y, z) = framed(5000, 1)
    place, away = places_from(x, y, z, np.eye(4, dtype=np.float32), frame.row_start, frame.columns)
    drawn = frame.place >= 0
    assert drawn.sum() == 5000 - 4
    np.testing.assert_array_equal(place[drawn], frame.place[drawn])
    np.testing.assert_allclose(away[drawn], frame.away_m[drawn], rtol=1e-6)
