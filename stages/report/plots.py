"""Figures for the charting library (plotly.js): traces and layouts as plain values, written as JSON into the page.

Colours are names of the page's own (`--curve-1`), which the page's script looks up, so that a figure is right on light
and dark pages and on paper. Texts are plain: what looks like a tag is shown as it stands.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

F8 = NDArray[np.float64]
I8 = NDArray[np.int64]
Trace = dict[str, Any]

MOST_POINTS = 2000
"""Points of a curve; longer ones are thinned."""
MOST_BANDS = 150
_LEAST_LOG_SPAN = 1.2
_FEW_DECADES = 2.5


@dataclass(frozen=True)
class Plot:
    """One figure: what kind of interaction it takes part in, and what the library draws."""

    label: str
    """What it shows, in words, for those who cannot see it."""
    data: list[Trace]
    layout: dict[str, Any]
    kind: str = "along"
    """`along` the way of a session, `plan` from above, or `bars`."""
    session: str = ""
    more: dict[str, Any] = field(default_factory=dict)
    """What the page's script needs besides, by kind."""

    def __bool__(self) -> bool:
        return bool(self.data)

    @property
    def json(self) -> str:
        """For a script element: no character in it ends one."""
        return script_json(
            {
                "kind": self.kind,
                "session": self.session,
                "data": self.data,
                "layout": self.layout,
                **self.more,
            }
        )


NOTHING = Plot("", [], {})


def script_json(value: Any) -> str:
    """JSON that can stand in a script element: `<`, `>` and `&` are written as escapes, and all text as ASCII."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def plain(text: str) -> str:
    """Text that the library, which understands a few tags, shows as it stands."""
    return escape(text, quote=False).replace("%{", "%\u200b{")


def short(values: Any, digits: int = 4) -> list[float | None]:
    """Values (n,) with so many significant digits; what is not finite is a gap."""
    return [
        float(f"{v:.{digits}g}") if math.isfinite(v) else None for v in np.asarray(values, float).tolist()
    ]


def fixed(values: Any, decimals: int = 2) -> list[float | None]:
    """Values (n,) with so many decimals; what is not finite is a gap."""
    return [round(v, decimals) if math.isfinite(v) else None for v in np.asarray(values, float).tolist()]


def thin(y: F8, most: int = MOST_POINTS) -> I8:
    """Rows of values (n,) to keep, `most` at most: the lowest and the highest of each stretch, so that no peak is hidden."""
    n = len(y)
    if n <= most:
        return np.arange(n)
    stretches = most // 2
    starts = np.linspace(0, n, stretches + 1).astype(np.int64)
    group = np.repeat(np.arange(stretches), np.diff(starts))
    row = np.arange(n)
    known = np.isfinite(y)
    low = np.lexsort((row, np.where(known, y, np.inf), group))[starts[:-1]]
    high = np.lexsort((row, np.where(known, -y, np.inf), group))[starts[:-1]]
    return np.unique(np.concatenate((low, high)))


def merged(ranges: F8, end: float, most: int = MOST_BANDS) -> F8:
    """Stretches (n, 2) in order, those less than a `most`-th of the whole apart as one."""
    if not len(ranges):
        return np.empty((0, 2))
    gap = end / most
    apart = np.flatnonzero(ranges[1:, 0] - ranges[:-1, 1] > gap) + 1
    return np.array([(group[0, 0], group[-1, 1]) for group in np.split(ranges, apart)])


def axis(title: str, **more: Any) -> dict[str, Any]:
    """A linear axis."""
    return {"title": {"text": plain(title), "standoff": 8}, "zeroline": False, **more}


def upwards(title: str, values: F8, **more: Any) -> dict[str, Any]:
    """An axis from zero to above all values."""
    top = float(np.nanmax(values, initial=0.0)) if len(values) else 0.0
    return axis(title, range=[0, 1.06 * top or 1.0], **more)


def logarithmic(title: str, values: F8, least: float) -> dict[str, Any]:
    """A logarithmic axis around all values above `least`; smaller ones lie on its lower end."""
    known = np.maximum(values[np.isfinite(values)], least)
    low, high = (np.log10(known.min()), np.log10(known.max())) if len(known) else (0.0, 0.0)
    spare = max(_LEAST_LOG_SPAN - (high - low), 0.16) / 2
    low, high = round(float(low - spare), 3), round(float(high + spare), 3)
    steps = (1, 2, 5) if high - low < _FEW_DECADES else (1,)
    marks = [float(f"{step}e{k}") for k in range(math.floor(low), math.ceil(high)) for step in steps]
    ticks = {"tickvals": marks, "ticktext": [f"{mark:g}" for mark in marks]}
    return axis(title, type="log", range=[low, high], **ticks)


def bands(ranges: F8, colour: str, end: float) -> list[dict[str, Any]]:
    """Stretches of x over the whole height, below the curves."""
    return [
        {
            "type": "rect", "xref": "x", "yref": "paper", "y0": 0, "y1": 1, "layer": "below", "line": {"width": 0},
            "x0": round(float(a), 2), "x1": round(max(float(b), float(a) + end / 600), 2), "fillcolor": colour,
        }
        for a, b in merged(ranges, end)
    ]  # fmt: skip


def rows_of(
    labels: Sequence[str], stretches: Sequence[F8], colour: str, end: float
) -> tuple[list[Trace], dict[str, Any]]:
    """A row for each label with its stretches of x marked: traces on `y2`, and that axis; it lies below the curves."""
    traces = []
    for k, ranges in enumerate(stretches):
        parts = merged(ranges, end)
        x = [
            None if v is None else v
            for a, b in parts.tolist()
            for v in (round(a, 2), round(max(b, a + end / 600), 2), None)
        ]
        traces.append(
            {
                "type": "scatter", "mode": "lines", "x": x, "y": [k if v is not None else None for v in x], "yaxis": "y2",
                "line": {"color": colour, "width": 7}, "hoverinfo": "skip", "showlegend": False,
            }
        )  # fmt: skip
    count = len(labels)
    rows = {
        "domain": [0, 0.062 * count + 0.02], "range": [count - 0.5, -0.5], "tickvals": list(range(count)), "fixedrange": True,
        "ticktext": [plain(label) for label in labels], "showgrid": False, "zeroline": False, "tickfont": {"size": 10},
    }  # fmt: skip
    return traces, rows
