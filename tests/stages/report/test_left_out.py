"""The picture and the table of what was left out."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT, RemovedTile
from scanloom.stages.report.figures import Figures
from scanloom.stages.report.left_out import COLOURS, WORDS, left_out, out_rows
from scanloom.stages.report.raster import View
from tests.metrics import metrics_table
from tests.tiles import tile_of

VIEW = View(0.0, 0.0, 40, 20, 0.5)


def test_points_are_drawn_in_the_colour_of_their_class_and_nothing_elsewhere() -> None:
    places = np.array([[5.2, 5.2, 0.0], [99.0, 5.0, 0.0], [5.2, 5.2, 3.0], [15.2, 5.2, 0.0]])
    both = tile_of(places, kind=RemovedTile, class_=int(PointClass.DYNAMIC))
    both.class_[(both.z_m > 1) | (both.x_m == np.float32(15.2))] = PointClass.OUTLIER
    drawn = np.asarray(left_out([both], VIEW))
    assert drawn.shape == (20, 40)
    values = [1 + LEFT_OUT.index(c) for c in (PointClass.DYNAMIC, PointClass.OUTLIER)]
    assert sorted(np.unique(drawn)) == sorted([0, *values])
    assert (drawn == values[0]).sum() == 9
    assert (drawn == values[1]).sum() == 9
    assert drawn[9, 10] == values[0]


def test_without_points_the_sheet_is_empty() -> None:
    assert not np.asarray(left_out([], VIEW)).any()


def test_sessions_add_up_and_shares_are_weighted() -> None:
    given = [("clean.dynamic_points", 10.0, "a"), ("clean.dynamic_share", 0.1, "a"),
             ("clean.dynamic_points", 10.0, "b"), ("clean.dynamic_share", 0.01, "b")]  # fmt: skip
    (row,) = out_rows(["a", "b"], Figures(metrics_table(given)))
    assert row.points == 20
    assert abs(row.percent - 100 * 20 / 1100) < 1e-9


def test_every_class_that_is_left_out_has_a_colour_and_words() -> None:
    assert set(COLOURS) == set(WORDS) == set(LEFT_OUT)
    assert out_rows(["a"], Figures(metrics_table([]))) == []
