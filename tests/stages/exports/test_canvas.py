"""Painting cell by cell, and filling holes: against plain loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.stages.exports.canvas import BLOCK, Canvas
from scanloom.stages.exports.holes import fill_holes


def painted(folder: Path, xy: np.ndarray, z: np.ndarray, parts: int = 1, **more: int) -> Canvas:
    folder.mkdir(exist_ok=True)
    canvas = Canvas(folder, 0.5, **more)
    for part in np.array_split(np.arange(len(xy)), parts):
        canvas.paint(xy[part], z[part])
    return canvas


def cloud(n: int = 5000, size: float = 400.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    return rng.uniform(-size / 2.0, size / 2.0, (n, 2)), rng.normal(100.0, 5.0, n)


def test_cells_hold_what_fell_into_them(tmp_path: Path) -> None:
    xy, z = cloud(2000, 40.0)
    canvas = painted(tmp_path, xy, z, parts=3)
    row, column, rows, columns = canvas.extent
    cells = canvas.window(row, column, rows, columns)
    assert cells["count"].sum() == len(xy)
    for i in range(rows):
        for j in range(columns):
            x, y = (column + j) * 0.5, (row + i) * 0.5
            inside = (xy[:, 0] >= x) & (xy[:, 0] < x + 0.5) & (xy[:, 1] >= y) & (xy[:, 1] < y + 0.5)
            assert cells[i, j]["count"] == inside.sum()
            if inside.any():
                assert cells[i, j]["sum"] == pytest.approx(z[inside].sum(), rel=1e-12)
                assert cells[i, j]["lowest"] == np.float32(z[inside].min())
                assert cells[i, j]["highest"] == np.float32(z[inside].max())
    edges = cells["count"]
    assert edges[0].any() and edges[-1].any() and edges[:, 0].any() and edges[:, -1].any()


def test_blocks_on_disk_change_nothing(tmp_path: Path) -> None:
    xy, z = cloud()
    roomy = painted(tmp_path / "a", xy, z, parts=4)
    tight = painted(tmp_path / "b", xy, z, parts=4, blocks_in_memory=2)
    assert len(list((tmp_path / "b").iterdir())) > 2 and not list((tmp_path / "a").iterdir())
    assert len(tight._blocks) <= 2
    assert roomy.extent == tight.extent
    np.testing.assert_array_equal(roomy.window(*roomy.extent), tight.window(*tight.extent))
    np.testing.assert_array_equal(roomy.highest_at(xy), tight.highest_at(xy))


def test_borders_of_blocks_belong_to_the_higher_one(tmp_path: Path) -> None:
    edge = BLOCK * 0.5
    xy = np.array([[edge, -edge], [np.nextafter(edge, 0.0), np.nextafter(-edge, -np.inf)], [0.0, -0.0]])
    canvas = painted(tmp_path, xy, np.arange(3.0))
    np.testing.assert_array_equal(canvas.cells_of(xy).T, [[-BLOCK, BLOCK], [-BLOCK - 1, BLOCK - 1], [0, 0]])
    assert canvas.window(-BLOCK, BLOCK, 1, 1)["sum"][0, 0] == 0.0
    assert canvas.window(-BLOCK - 1, BLOCK - 1, 1, 1)["sum"][0, 0] == 1.0
    assert canvas.window(0, 0, 1, 1)["sum"][0, 0] == 2.0
    assert canvas.window(-BLOCK - 1, BLOCK - 1, 2, 2)["count"].sum() == 2


def test_nothing_painted(tmp_path: Path) -> None:
    canvas = painted(tmp_path, np.empty((0, 2)), np.empty(0))
    assert canvas.empty and canvas.extent == (0, 0, 0, 0)
    assert len(canvas.highest_at(np.empty((0, 2)))) == 0


def with_margin(values: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """One layer with an unknown margin, as the function wants it."""
    wide = np.pad(values.astype(np.float32), reach, constant_values=np.nan)
    return wide[None], ~np.isnan(wide)


def test_a_hole_is_filled_from_all_sides() -> None:
    rows, columns = np.mgrid[0:20, 0:20]
    slope = 2.0 * rows - 1.0 * columns
    holed = slope.astype(float)
    holed[8:11, 9:12] = np.nan
    (filled,), has = fill_holes(*with_margin(holed, 4), 4)
    assert has.all()
    # Around the middle of a plane all weights are symmetric; off the middle the mean leans to the nearer side.
    assert filled[9, 10] == pytest.approx(slope[9, 10], abs=1e-5)
    assert np.abs(filled - slope).max() < 1.5
    np.testing.assert_array_equal(filled[np.isfinite(holed)], slope[np.isfinite(holed)].astype(np.float32))


def test_the_middle_of_a_hole_wider_than_the_reach_stays_empty() -> None:
    holed = np.zeros((40, 40))
    holed[10:30, 10:30] = np.nan
    _, has = fill_holes(*with_margin(holed, 3), 3)
    assert not has[14:26, 14:26].any()
    assert not has[10:30, 10].any(), "the straight side of a large hole is no hole"
    assert not has[20, 10:30].any()


@pytest.mark.parametrize("angle", np.linspace(0.0, 2.0 * np.pi, 25))
def test_no_straight_edge_grows(angle: float) -> None:
    rows, columns = np.mgrid[-20:20, -20:20]
    outside = np.cos(angle) * columns + np.sin(angle) * rows > 0.3
    values = np.where(outside, np.nan, 1.0)
    _, has = fill_holes(*with_margin(values, 4), 4)
    np.testing.assert_array_equal(has, ~outside)


@pytest.mark.parametrize("gap, filled", [(5, False), (4, True)])
def test_reach_is_the_stated_distance(gap: int, filled: bool) -> None:
    values = np.full((2 * gap + 1, 2 * gap + 1), np.nan)
    for up, right in ((0, gap), (gap, 0), (0, -gap), (-gap, 0)):
        values[gap + up, gap + right] = 3.0
    _, has = fill_holes(*with_margin(values, 4), 4)
    assert has[gap, gap] == filled


def test_windows_do_not_show() -> None:
    """Filling by windows with a margin gives the same bits as filling at once."""
    rng = np.random.default_rng(5)
    values = np.where(rng.random((60, 70)) < 0.3, np.nan, rng.normal(500.0, 3.0, (60, 70)))
    wide, known = with_margin(values, 4)
    (whole,), has = fill_holes(wide, known, 4)
    for row in range(0, 60, 20):
        for column in range(0, 70, 35):
            part = (slice(row, row + 28), slice(column, column + 43))
            (filled,), here = fill_holes(wide[:, *part], known[part], 4)
            np.testing.assert_array_equal(here, has[row : row + 20, column : column + 35])
            same = whole[row : row + 20, column : column + 35]
            np.testing.assert_array_equal(filled[here], same[here])


def test_no_reach_fills_nothing() -> None:
    values = np.array([[1.0, np.nan, 1.0]])
    _, has = fill_holes(*with_margin(values, 0), 0)
    np.testing.assert_array_equal(has, [[True, False, True]])


def test_weights_are_inverse_squares_of_the_distance() -> None:
    values = np.full((5, 5), np.nan)
    values[2, 4], values[4, 2], values[2, 1], values[0, 2] = 10.0, 20.0, 30.0, 40.0
    two = np.stack([with_margin(v, 2)[0][0] for v in (values, -values)])
    filled, has = fill_holes(two, with_margin(values, 2)[1], 2)
    assert has[2, 2]
    want = (10.0 / 4 + 20.0 / 4 + 30.0 / 1 + 40.0 / 4) / (3 / 4 + 1)
    np.testing.assert_allclose(filled[:, 2, 2], [want, -want], rtol=1e-6)
