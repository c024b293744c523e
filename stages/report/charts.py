"""Charts along the way: curves, dots and bands as inline SVG, axes in plain HTML.

The drawing is stretched to the width of the page while letters, lines and dots keep their size, so that a chart is
legible on a wide screen and on a phone. Colours are the page's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

F8 = NDArray[np.float64]

_WIDTH, _HEIGHT = 1000, 200
_MAX_POINTS = 500
_MAX_BANDS = 300


@dataclass(frozen=True)
class Axis:
    """Values from `low` to `high`; with `log` by their decimal logarithm."""

    low: float
    high: float
    ticks: tuple[float, ...]
    log: bool = False

    def share(self, values: F8) -> F8:
        """Where on the axis values (n,) lie, 0 to 1; what is beyond an end lies on it."""
        low, high = (np.log10(self.low), np.log10(self.high)) if self.log else (self.low, self.high)
        at = np.log10(np.maximum(values, self.low)) if self.log else np.asarray(values, float)
        return np.asarray(np.clip((at - low) / (high - low), 0.0, 1.0))


def linear(high: float) -> Axis:
    """From 0 to a round value just above `high`."""
    top = nice_top(high)
    return Axis(0.0, top, tuple(ticks(top)))


def exact(high: float) -> Axis:
    """From 0 to `high` itself, with round values marked: distances driven."""
    end = high if high > 0 else 1.0
    return Axis(0.0, end, tuple(ticks(end)))


def logarithmic(low: float, high: float) -> Axis:
    """Whole decades from `low`, a power of ten, to at least one above it and at least `high`."""
    first = round(np.log10(low))
    last = max(int(np.ceil(np.log10(max(high, low)))), first + 1)
    step = -(-(last - first) // 6)
    return Axis(low, 10.0**last, tuple(10.0**k for k in range(first, last + 1, step)), log=True)


@dataclass(frozen=True)
class Curve:
    """Values y (n,) over x (n,), drawn with the page's colour `--curve-NUMBER`."""

    label: str
    x: F8
    y: F8
    number: int

    def draw(self, x_axis: Axis, y_axis: Axis) -> str:
        x, y = thin(self.x, self.y)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(*_place(x, y, x_axis, y_axis)))
        title = f"<title>{escape(self.label)}</title>"
        return f'<polyline points="{points}" class="curve curve-{self.number}">{title}</polyline>'


@dataclass(frozen=True)
class Dots:
    """Values y (n,) at x (n,) as dots of the page's style `dots-KIND`."""

    label: str
    x: F8
    y: F8
    kind: str

    def draw(self, x_axis: Axis, y_axis: Axis) -> str:
        # A line without length has a round end at both sides: a dot that keeps its shape when the drawing is stretched.
        x, y = _place(*thin(self.x, self.y), x_axis, y_axis)
        path = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x, y))
        return f'<path d="{path}" class="dots dots-{self.kind}"><title>{escape(self.label)}</title></path>'


@dataclass(frozen=True)
class Bands:
    """Stretches (n, 2) of x over the whole height, in the page's style `band-KIND`."""

    label: str
    ranges: F8
    kind: str

    def draw(self, x_axis: Axis, y_axis: Axis) -> str:
        return _boxes(self.ranges, x_axis, f"band band-{self.kind}", _HEIGHT, self.label)


@dataclass(frozen=True)
class Strip:
    """A row below the chart with stretches (n, 2) of x marked."""

    label: str
    ranges: F8
    kind: str


Layer = Curve | Dots | Bands


def chart(
    layers: Sequence[Layer],
    x_axis: Axis,
    y_axis: Axis,
    x_label: str,
    y_label: str,
    strips: Sequence[Strip] = (),
) -> str:
    """A figure of the layers, the first one lowest, with strips below."""
    grid = "".join(
        f'<path d="M0 {_HEIGHT * (1 - float(s)):.1f}H{_WIDTH}" class="grid"/>'
        for s in y_axis.share(np.array(y_axis.ticks))
    )
    drawn = "".join(layer.draw(x_axis, y_axis) for layer in layers)
    return "".join(
        [
            f'<figure class="plot" role="img" aria-label="{escape(y_label)} over {escape(x_label)}">',
            f'<span class="up">{escape(y_label)}</span>',
            _tick_labels("ys", "bottom", y_axis),
            f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" preserveAspectRatio="none">{grid}{drawn}</svg>',
            *(_strip(strip, x_axis) for strip in strips),
            _tick_labels("xs", "left", x_axis),
            f'<span class="along">{escape(x_label)}</span></figure>',
        ]
    )


def line_chart(curves: Sequence[Curve], x_label: str, y_label: str) -> str:
    """Curves that start at zero; empty when there is nothing to draw."""
    curves = [curve for curve in curves if len(curve.x)]
    if not curves:
        return ""
    x_axis = exact(max(float(curve.x.max()) for curve in curves))
    y_axis = linear(max(float(curve.y.max()) for curve in curves))
    return chart(curves, x_axis, y_axis, x_label, y_label)


def ticks(high: float) -> list[float]:
    """Round values from 0 to `high`, four to nine of them."""
    raw = high / 5
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(s * power for s in (1, 2, 2.5, 5, 10) if s * power >= raw * 0.999)
    return [float(f"{k * step:.6g}") for k in range(int(high / step * 1.0001) + 1)]


def nice_top(high: float) -> float:
    """The upper end of an axis: a round value just above `high`."""
    high = max(high, 0.01)
    step = ticks(high)[1]
    return float(np.ceil(high / step * 0.9999) * step)


def thin(x: F8, y: F8) -> tuple[F8, F8]:
    """At most `_MAX_POINTS` points; of each group the highest stays, so that no peak is hidden."""
    if len(x) <= _MAX_POINTS:
        return x, y
    starts = np.linspace(0, len(x), _MAX_POINTS + 1).astype(np.int64)
    group = np.repeat(np.arange(_MAX_POINTS), np.diff(starts))
    order = np.lexsort((np.arange(len(x)), -y, group))
    picks = order[starts[:-1]]
    return x[picks], y[picks]


def _place(x: F8, y: F8, x_axis: Axis, y_axis: Axis) -> tuple[F8, F8]:
    return _WIDTH * x_axis.share(x), _HEIGHT * (1.0 - y_axis.share(y))


def _boxes(ranges: F8, x_axis: Axis, style: str, height: float, label: str) -> str:
    """One path of rectangles; neighbours that a pixel would not part are one."""
    if not len(ranges):
        return ""
    ends = _merged(_WIDTH * x_axis.share(ranges), _WIDTH / _MAX_BANDS / 2)
    path = "".join(f"M{a:.1f} 0H{max(b, a + 1.5):.1f}V{height}H{a:.1f}z" for a, b in ends)
    return f'<path d="{path}" class="{style}"><title>{escape(label)}</title></path>'


def _merged(ranges: F8, gap: float) -> F8:
    """Stretches (n, 2) in order, those less than `gap` apart as one."""
    apart = np.flatnonzero(ranges[1:, 0] - ranges[:-1, 1] > gap) + 1
    groups = np.split(ranges, apart)
    return np.array([(group[0, 0], group[-1, 1]) for group in groups])


def _strip(strip: Strip, x_axis: Axis) -> str:
    boxes = _boxes(strip.ranges, x_axis, f"strip-{strip.kind}", 10, strip.label)
    return (
        f'<span class="row">{escape(strip.label)}</span>'
        f'<svg class="row" viewBox="0 0 {_WIDTH} 10" preserveAspectRatio="none">{boxes}</svg>'
    )


def _tick_labels(style: str, side: str, axis: Axis) -> str:
    shares = axis.share(np.array(axis.ticks))
    marks = "".join(f'<i style="{side}:{100 * float(s):.1f}%">{v:g}</i>' for v, s in zip(axis.ticks, shares))
    return f'<span class="{style}">{marks}</span>'
