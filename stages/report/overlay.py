"""What is drawn over the map: trajectories, loops, GNSS, scale; once as SVG, once into the picture."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from scanloom.stages.report.raster import View

SESSION_COLOURS = ("#ff7a45", "#4cc9f0", "#f72585", "#b8f04c", "#c77dff", "#ffd166")
LOOP_COLOUR = "#7CFC98"
GNSS_COLOUR = "#ffe08a"
INK = "#f0f6fc"


@dataclass(frozen=True)
class Line:
    """A polyline through pixels (n, 2)."""

    points: NDArray[np.float64]
    colour: str
    width: float
    opacity: float = 1.0


@dataclass(frozen=True)
class Dot:
    """A filled circle at pixel (x, y), with an optional tooltip."""

    x: float
    y: float
    radius: float
    colour: str
    opacity: float = 1.0
    tip: str = ""


@dataclass(frozen=True)
class Label:
    """Text with its middle at pixel x and its base line at y."""

    x: float
    y: float
    text: str
    size: float
    colour: str = INK


Mark = Line | Dot | Label


def scale_bar(view: View) -> list[Mark]:
    """A bar of a round length at the lower left and a north arrow at the upper right."""
    unit = view_unit(view)
    length = round_length(view.width * view.pixel_m / 5)
    x, y = 3 * unit, view.height - 3 * unit
    end = x + length / view.pixel_m
    bar = np.array([[x, y - 0.6 * unit], [x, y], [end, y], [end, y - 0.6 * unit]])
    north = view.width - 3 * unit
    arrow = np.array([[north - unit, 5 * unit], [north, 2 * unit], [north + unit, 5 * unit], [north, 4.2 * unit],
                      [north - unit, 5 * unit]])  # fmt: skip
    text = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    return [
        Line(bar, INK, 0.3 * unit),
        Label((x + end) / 2, y - unit, text, 1.9 * unit),
        Line(arrow, INK, 0.3 * unit),
        Label(north, 7 * unit, "N", 1.9 * unit),
    ]


def view_unit(view: View) -> float:
    """A hundredth of the longer side: the measure of line widths and letters, pixels."""
    return max(view.width, view.height) / 100


def round_length(about: float) -> float:
    """The largest of 1, 2, 5, 10, 20, ... that does not exceed `about`."""
    power = 10.0 ** np.floor(np.log10(max(about, 1e-9)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= about))


def to_svg(marks: list[Mark], view: View) -> str:
    """An SVG of the marks with the picture's pixels as its coordinates."""
    body = "".join(_svg(mark) for mark in marks)
    return f'<svg viewBox="0 0 {view.width} {view.height}" class="overlay" role="img">{body}</svg>'


def _svg(mark: Mark) -> str:
    if isinstance(mark, Line):
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in mark.points)
        return (
            f'<polyline points="{path}" fill="none" stroke="{mark.colour}" stroke-width="{mark.width:.2f}" '
            f'stroke-opacity="{mark.opacity:g}" stroke-linejoin="round" stroke-linecap="round"/>'
        )
    if isinstance(mark, Dot):
        tip = f"<title>{escape(mark.tip)}</title>" if mark.tip else ""
        return (
            f'<circle cx="{mark.x:.1f}" cy="{mark.y:.1f}" r="{mark.radius:.1f}" fill="{mark.colour}" '
            f'fill-opacity="{mark.opacity:g}">{tip}</circle>'
        )
    return (
        f'<text x="{mark.x:.1f}" y="{mark.y:.1f}" font-size="{mark.size:.1f}" fill="{mark.colour}" '
        f'text-anchor="middle">{escape(mark.text)}</text>'
    )


def paint(picture: NDArray[np.uint8], marks: list[Mark]) -> Image.Image:
    """The picture with the marks on it, drawn at twice the size for smooth edges."""
    base = Image.fromarray(picture).convert("RGBA")
    layer = Image.new("RGBA", (base.width * 2, base.height * 2), (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    for mark in marks:
        _paint(draw, mark)
    smooth = layer.resize(base.size, Image.Resampling.BOX)
    return Image.alpha_composite(base, smooth).convert("RGB")


def _paint(draw: ImageDraw.ImageDraw, mark: Mark) -> None:
    if isinstance(mark, Line):
        points = [(float(x) * 2, float(y) * 2) for x, y in mark.points]
        draw.line(
            points, fill=_rgba(mark.colour, mark.opacity), width=max(round(mark.width * 2), 1), joint="curve"
        )
    elif isinstance(mark, Dot):
        x, y, r = mark.x * 2, mark.y * 2, mark.radius * 2
        draw.ellipse((x - r, y - r, x + r, y + r), fill=_rgba(mark.colour, mark.opacity))
    else:
        font = ImageFont.load_default(mark.size * 2)
        draw.text((mark.x * 2, mark.y * 2), mark.text, fill=_rgba(mark.colour, 1.0), font=font, anchor="ms")


def _rgba(colour: str, opacity: float) -> tuple[int, int, int, int]:
    r, g, b = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return r, g, b, round(255 * opacity)
