"""Figures from above: the tracks of all sessions, with marks on them, or coloured by what is known of each scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.report.overlay import SESSION_COLOURS
from scanloom.stages.report.plots import I8, NOTHING, Plot, Trace, fixed, plain, short
from scanloom.stages.report.ways import Way

_MOST_BEADS = 2400
"""Scans drawn, of all sessions together."""
_PERCENTILES = (1.0, 99.0)
PLAN_HOVER = "%{text}<br>scan %{customdata[0]}, stamp %{customdata[1]:.2f} s<br>%{customdata[2]:.1f} m driven<extra></extra>"


@dataclass(frozen=True)
class Quantity:
    """What the track can be coloured by: values (n,) of the scans of each session."""

    key: str
    label: str
    unit: str
    values: dict[str, F8]
    worse: bool = False
    """More is worse."""


def track_plan(ways: Mapping[str, Way], quantities: list[Quantity], marks: list[Trace]) -> Plot:
    """Every session's track, which the page's script colours by the quantity that is chosen."""
    if not ways:
        return NOTHING
    each = max(_MOST_BEADS // len(ways), 50)
    rows = {name: _spread(len(way), each) for name, way in ways.items()}
    data = _tracks(ways)
    for number, (name, way) in enumerate(ways.items()):
        data.append(_beads(name, way, rows[name], SESSION_COLOURS[number % len(SESSION_COLOURS)]))
    more = {
        "beads": {name: len(ways) + k for k, name in enumerate(ways)},
        "colours": [_coloured(quantity, rows) for quantity in quantities],
    }
    return Plot(
        "The tracks from above, coloured by a figure to choose", data + marks, _layout(), "plan", "", more
    )


def marks_plan(label: str, ways: Mapping[str, Way], marks: list[Trace]) -> Plot:
    """The tracks in grey with marks on them."""
    return Plot(label, _tracks(ways) + marks, _layout(), "plan") if ways and marks else NOTHING


def _layout() -> dict[str, Any]:
    shown = {"zeroline": False, "constrain": "range", "ticksuffix": " m"}
    return {"xaxis": {**shown}, "yaxis": {**shown, "scaleanchor": "x", "scaleratio": 1}}


def _tracks(ways: Mapping[str, Way]) -> list[Trace]:
    lines: list[Trace] = []
    for name, way in ways.items():
        rows = _spread(len(way), _MOST_BEADS // max(len(ways), 1) + 50)
        lines.append(
            {
                "type": "scatter", "mode": "lines", "name": plain(name), "x": fixed(way.place_m[rows, 0]),
                "y": fixed(way.place_m[rows, 1]), "line": {"color": "--quiet", "width": 2}, "hoverinfo": "skip",
                "showlegend": False,
            }
        )  # fmt: skip
    return lines


def _beads(name: str, way: Way, rows: I8, colour: str) -> Trace:
    told = [[*pair, driven] for pair, driven in zip(way.told(rows), fixed(way.driven_m[rows], 1))]
    return {
        "type": "scatter", "mode": "markers", "name": plain(name), "x": fixed(way.place_m[rows, 0]),
        "y": fixed(way.place_m[rows, 1]), "customdata": told, "text": plain(name), "hovertemplate": PLAN_HOVER,
        "marker": {"size": 6, "color": colour}, "meta": {"session": name, "start_s": way.start_s}, "showlegend": False,
    }  # fmt: skip


def _coloured(quantity: Quantity, rows: Mapping[str, I8]) -> dict[str, Any]:
    """Values at the drawn scans, and the range of colours: all but the rarest hundredth at each end."""
    values = {name: found[rows[name]] for name, found in quantity.values.items() if name in rows}
    known = np.concatenate([v[np.isfinite(v)] for v in values.values()] or [np.empty(0)])
    low, high = np.percentile(known, _PERCENTILES) if len(known) else (0.0, 1.0)
    return {
        "key": quantity.key, "label": quantity.label, "unit": quantity.unit, "worse": quantity.worse, "low": float(f"{low:.4g}"),
        "high": float(f"{max(high, low + 1e-6):.4g}"), "values": {name: short(v) for name, v in values.items()},
    }  # fmt: skip


def _spread(count: int, most: int) -> I8:
    """Rows evenly over all, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
