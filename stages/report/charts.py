"""Line charts as inline SVG: small, sharp, and in the colours of the page."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

_WIDTH, _HEIGHT = 860, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 14, 14, 40
_MAX_POINTS = 500


@dataclass(frozen=True)
class Curve:
    """Values y (n,) over x (n,), drawn with the page's colour `--curve-NUMBER`."""

    label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    number: int


def line_chart(curves: list[Curve], x_label: str, y_label: str) -> str:
    """An SVG with one or more curves that start at zero; empty when there is nothing to draw."""
    curves = [curve for curve in curves if len(curve.x)]
    if not curves:
        return ""
    x_high = max(float(curve.x.max()) for curve in curves) or 1.0
    y_high = nice_top(max(float(curve.y.max()) for curve in curves))
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" class="chart" role="img" aria-label="{escape(y_label)}">'
    ]
    for value in ticks(y_high):
        y = _y(value, y_high)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value in ticks(x_high):
        x = _x(value, x_high)
        parts.append(
            f'<text class="tick" x="{x:.1f}" y="{_HEIGHT - 22}" text-anchor="middle">{value:g}</text>'
        )
    parts += [_path(curve, x_high, y_high) for curve in curves]
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(
        f'<text class="axis" x="{middle}" y="{_HEIGHT - 5}" text-anchor="middle">{escape(x_label)}</text>'
    )
    up = (_TOP + _HEIGHT - _BOTTOM) / 2
    parts.append(
        f'<text class="axis" transform="translate(13 {up}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>'
    )
    return "".join([*parts, "</svg>"])


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


def _x(value: float, high: float) -> float:
    return _LEFT + value / high * (_WIDTH - _LEFT - _RIGHT)


def _y(value: float, high: float) -> float:
    return _HEIGHT - _BOTTOM - value / high * (_HEIGHT - _TOP - _BOTTOM)


def _path(curve: Curve, x_high: float, y_high: float) -> str:
    x, y = thin(curve.x, curve.y)
    points = " ".join(f"{_x(a, x_high):.1f},{_y(b, y_high):.1f}" for a, b in zip(x, y))
    return f'<polyline points="{points}" class="curve curve-{curve.number}"><title>{escape(curve.label)}</title></polyline>'


def thin(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most `_MAX_POINTS` points; of each group the highest stays, so that no peak is hidden."""
    if len(x) <= _MAX_POINTS:
        return x, y
    groups = np.array_split(np.arange(len(x)), _MAX_POINTS)
    picks = np.array([group[np.argmax(y[group])] for group in groups])
    return x[picks], y[picks]
