"""What was left out of the map, as a transparent picture to lay over it, and how to read it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT, RemovedTile
from scanloom.stages.report.figures import Figures
from scanloom.stages.report.raster import View

COLOURS: Mapping[PointClass, tuple[int, int, int]] = {
    PointClass.DYNAMIC: (255, 77, 79),
    PointClass.AIRBORNE: (105, 192, 255),
    PointClass.OUTLIER: (180, 180, 180),
    PointClass.CHANGED: (255, 192, 61),
}
WORDS: Mapping[PointClass, str] = {
    PointClass.DYNAMIC: "moving",
    PointClass.AIRBORNE: "in the air: dust, rain, snow",
    PointClass.OUTLIER: "strays",
    PointClass.CHANGED: "gone since: seen through by a later session",
}
DRAWN = (PointClass.OUTLIER, PointClass.AIRBORNE, PointClass.CHANGED, PointClass.DYNAMIC)
"""What lies on top is last."""
SPREAD_PX = 1
"""A point is a square of this many pixels to each side."""


def left_out(tiles: Iterable[RemovedTile], view: View) -> Image.Image:
    """Picture in a few colours, transparent where nothing was left out; moving points lie on top."""
    index = np.zeros((view.height, view.width), np.uint8)
    for tile in tiles:
        xy = np.column_stack((tile.x_m, tile.y_m)).astype(float) + np.array(tile.offset_m[:2])
        pixel = np.floor(view.pixels(xy)).astype(np.int64)
        for class_ in DRAWN:
            _dots(index, pixel[tile.class_ == class_], 1 + LEFT_OUT.index(class_))
    image = Image.fromarray(index, "P")
    image.putpalette(bytes(v for colour in ((0, 0, 0), *(COLOURS[c] for c in LEFT_OUT)) for v in colour))
    return image


def _dots(index: np.ndarray, pixel: np.ndarray, value: int) -> None:
    height, width = index.shape
    for dx in range(-SPREAD_PX, SPREAD_PX + 1):
        for dy in range(-SPREAD_PX, SPREAD_PX + 1):
            x, y = pixel[:, 0] + dx, pixel[:, 1] + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            index[y[inside], x[inside]] = value


@dataclass(frozen=True)
class OutRow:
    """One class of points that are not in the map."""

    colour: str
    words: str
    points: float
    percent: float


def out_rows(sessions: Sequence[str], figures: Figures) -> list[OutRow]:
    """One row for each class that was left out, all sessions together; none when nothing was counted."""
    rows = []
    for class_ in LEFT_OUT:
        name = f"clean.{class_.name.lower()}"
        points = [figures.get(f"{name}_points", session) or 0.0 for session in sessions]
        share = [figures.get(f"{name}_share", session) or 0.0 for session in sessions]
        usable = sum(p / s for p, s in zip(points, share) if s > 0.0)
        if sum(points):
            colour = "#{:02x}{:02x}{:02x}".format(*COLOURS[class_])
            rows.append(OutRow(colour, WORDS[class_], sum(points), 100.0 * sum(points) / usable))
    return rows
