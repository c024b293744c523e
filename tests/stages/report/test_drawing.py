"""Views, scales and charts."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.report.charts import (
    Bands,
    Curve,
    Dots,
    Strip,
    chart,
    exact,
    line_chart,
    linear,
    logarithmic,
    nice_top,
    thin,
    ticks,
)
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


def test_thinning_is_that_of_a_plain_loop() -> None:
    y = np.random.default_rng(0).normal(size=1777)
    x_thin, y_thin = thin(np.arange(1777.0), y)
    groups = np.split(np.arange(1777), np.linspace(0, 1777, 501).astype(int)[1:-1])
    assert x_thin.tolist() == [float(group[np.argmax(y[group])]) for group in groups]
    assert np.array_equal(y_thin, y[x_thin.astype(int)])


@pytest.mark.parametrize(
    ("low", "high", "want"),
    [
        (0.001, 0.0, [0.001, 0.01]),
        (0.001, 5.0, [0.001, 0.01, 0.1, 1, 10]),
        (0.01, 0.1, [0.01, 0.1]),
        (1.0, 1.1e7, [1, 1e2, 1e4, 1e6, 1e8]),
    ],
)
def test_decades_cover_every_value_and_are_few(low: float, high: float, want: list[float]) -> None:
    axis = logarithmic(low, high)
    assert list(axis.ticks) == pytest.approx(want)
    assert axis.high >= high
    assert len(axis.ticks) <= 7


def test_shares_are_those_of_the_axis_and_stay_on_it() -> None:
    axis = logarithmic(0.01, 100.0)
    assert axis.share(np.array([0.01, 1.0, 100.0, 0.0, -5.0, 1e9])).tolist() == pytest.approx(
        [0, 0.5, 1, 0, 0, 1]
    )
    assert linear(9.0).share(np.array([0.0, 5.0])).tolist() == [0.0, 0.5]
    assert exact(0.0).share(np.array([0.0])).tolist() == [0.0]


def test_dots_stand_where_their_values_are() -> None:
    drawn = Dots("fixes", np.array([25.0, 100.0]), np.array([1.0, 0.1]), "used").draw(
        exact(100.0), logarithmic(0.01, 1.0)
    )
    assert 'd="M250.0 0.0h0M1000.0 100.0h0"' in drawn


def test_bands_are_merged_where_nobody_could_tell_them_apart_and_never_vanish() -> None:
    x_axis = exact(1000.0)
    ranges = np.array([[100.0, 100.0], [400.0, 420.0], [420.5, 450.0], [470.0, 480.0]])
    drawn = Bands("blind", ranges, "blind").draw(x_axis, linear(1.0))
    assert "M100.0 0H101.5V" in drawn
    assert "M400.0 0H450.0V" in drawn
    assert drawn.count("z") == 3
    crowd = np.column_stack((np.arange(0.0, 1000.0, 0.1), np.arange(0.0, 1000.0, 0.1) + 0.05))
    assert Bands("blind", crowd, "blind").draw(x_axis, linear(1.0)).count("z") == 1
    assert Bands("blind", np.empty((0, 2)), "blind").draw(x_axis, linear(1.0)) == ""


def test_a_chart_has_labels_of_both_axes_and_rows_below() -> None:
    strips = [Strip("along", np.array([[0.0, 5.0]]), "blind"), Strip("<up>", np.empty((0, 2)), "blind")]
    drawn = chart([], exact(10.0), linear(1.0), "way & time", "error, m", strips)
    assert drawn.count("<svg") == 3
    assert "way &amp; time" in drawn
    assert "&lt;up&gt;" in drawn
    assert drawn.count("left:") == len(ticks(10.0))
