"""Views, scales and charts."""

from __future__ import annotations

import json

import numpy as np
import pytest

from scanloom.stages.report.figures import number
from scanloom.stages.report.overlay import round_length
from scanloom.stages.report.plots import (
    bands,
    logarithmic,
    merged,
    plain,
    rows_of,
    script_json,
    short,
    thin,
    upwards,
)
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


def test_thinning_keeps_every_peak_and_every_dip() -> None:
    y = np.zeros(36_000)
    y[4321], y[20_000], y[20_001] = 7.0, -3.0, 9.0
    rows = thin(y)
    assert len(rows) <= 2000
    assert {4321, 20_000, 20_001} <= set(rows.tolist())
    assert (np.diff(rows) > 0).all()


@pytest.mark.parametrize("count", [0, 1, 2000])
def test_short_curves_are_whole(count: int) -> None:
    assert thin(np.zeros(count)).tolist() == list(range(count))


def test_thinning_skips_what_is_unknown_and_keeps_a_long_gap() -> None:
    y = np.random.default_rng(0).normal(size=9000)
    y[::2] = np.nan
    y[4000:6000] = np.nan
    rows = thin(y)
    kept = np.isfinite(y[rows])
    assert kept[(rows < 3990) | (rows > 6010)].all()
    assert not kept[(rows >= 4010) & (rows < 5990)].any()
    assert y[rows][kept].max() == np.nanmax(y)


def test_numbers_are_short() -> None:
    assert number(12345678.0) == "12\u2009345\u2009678"
    assert number(0.123456) == "0.1235"
    assert number(1e-15) == "0"
    assert number(float("nan")) == "–"


@pytest.mark.parametrize(
    ("values", "low", "high"), [([0.001, 5.0], 0.001, 5.0), ([0.0, 1.0], 0.001, 1.0), ([2.0], 2.0, 2.0)]
)
def test_logarithmic_axes_show_every_value(values: list[float], low: float, high: float) -> None:
    axis = logarithmic("y", np.array([*values, np.nan]), 0.001)
    a, b = axis["range"]
    assert a < np.log10(low)
    assert b > np.log10(high)
    assert b - a >= 1.2


def test_axes_from_zero_show_every_value_and_are_never_empty() -> None:
    assert upwards("y", np.array([1.0, np.nan, 3.0]))["range"] == [0, pytest.approx(3.18)]
    assert upwards("y", np.zeros(3))["range"] == [0, 1.0]
    assert upwards("y", np.empty(0))["range"] == [0, 1.0]


def test_bands_are_merged_where_nobody_could_tell_them_apart_and_never_vanish() -> None:
    ranges = np.array([[100.0, 100.0], [400.0, 420.0], [420.5, 450.0], [470.0, 480.0]])
    assert [(b["x0"], b["x1"]) for b in bands(ranges, "--band", 1000.0)] == [
        (100.0, pytest.approx(101.67)), (400.0, 450.0), (470.0, 480.0)
    ]  # fmt: skip
    crowd = np.column_stack((np.arange(0.0, 1000.0, 0.1), np.arange(0.0, 1000.0, 0.1) + 0.05))
    assert len(merged(crowd, 1000.0)) == 1
    assert bands(np.empty((0, 2)), "--band", 1000.0) == []


def test_rows_have_a_label_each_and_gaps_between_their_stretches() -> None:
    traces, below = rows_of(
        ["along", "<up>"], [np.array([[0.0, 5.0], [7.0, 9.0]]), np.empty((0, 2))], "--c", 10.0
    )
    assert traces[0]["x"] == [0.0, 5.0, None, 7.0, 9.0, None]
    assert traces[0]["y"] == [0, 0, None, 0, 0, None]
    assert traces[1]["x"] == []
    assert below["ticktext"] == ["along", "&lt;up&gt;"]


def test_values_are_short_and_gaps_are_null() -> None:
    assert short(np.array([1.23456789, np.nan, np.inf, 12345678.0])) == [1.235, None, None, 12350000.0]
    assert plain("a<b> & %{x}") == "a&lt;b&gt; &amp; %\u200b{x}"


def test_nothing_in_a_script_element_ends_it() -> None:
    text = script_json({"a": "</script><!-- \u2028 & é"})
    assert not set("<>&\u2028é") & set(text)
    assert json.loads(text) == {"a": "</script><!-- \u2028 & é"}
    with pytest.raises(ValueError, match="JSON"):
        script_json(float("nan"))
