"""Views, scales and charts."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.report.charts import Curve, line_chart, nice_top, thin, ticks
from scanloom.stages.report.figures import number
from scanloom.stages.report.overlay import round_length
from scanloom.stages.report.raster import fit_view


def test_a_view_shows_the_rectangle_and_its_margin() -> None:
    view = fit_view([-100.0, 20.0], [300.0, 120.0], 40.0, 800, 0.1)
    corners = view.pixels(np.array([[-140.0, -20.0], [340.0, 160.0]]))
    assert (corners >= -1e-9).all()
    assert (corners <= [view.width, view.height]).all()
    assert view.width == 800
    assert corners[0, 1] > corners[1, 1]  # north is up


def test_a_view_is_no_finer_than_the_voxels_and_never_empty() -> None:
    view = fit_view([0.0, 0.0], [0.0, 0.0], 0.0, 800, 0.125)
    assert view.pixel_m == 0.125
    assert min(view.width, view.height) >= 16


@pytest.mark.parametrize(("about", "want"), [(7.3, 5), (10.0, 10), (0.34, 0.2), (999, 500), (2500, 2000)])
def test_lengths_are_round(about: float, want: float) -> None:
    assert round_length(about) == pytest.approx(want)


@pytest.mark.parametrize("high", [0.03, 0.7, 1.0, 3.9, 12.0, 99.0, 1013.0])
def test_ticks_are_few_and_reach_the_top(high: float) -> None:
    values = ticks(high)
    assert 3 <= len(values) <= 11
    assert values[0] == 0
    assert values[-1] <= high * 1.001
    assert high * 0.999 <= nice_top(high) <= high * 1.5


def test_thinning_keeps_every_peak() -> None:
    y = np.zeros(10_000)
    y[4321] = 7.0
    x_thin, y_thin = thin(np.arange(10_000.0), y)
    assert len(x_thin) <= 500
    assert y_thin.max() == 7.0
    assert x_thin[np.argmax(y_thin)] == 4321


def test_charts_of_nothing_and_of_zero() -> None:
    assert line_chart([], "x", "y") == ""
    flat = line_chart([Curve("flat", np.zeros(1), np.zeros(1), 1)], "x", "y")
    assert "nan" not in flat
    assert flat.startswith("<figure")


def test_numbers_are_short() -> None:
    assert number(12345678.0) == "12\u2009345\u2009678"
    assert number(0.123456) == "0.1235"
    assert number(1e-15) == "0"
    assert number(float("nan")) == "–"
