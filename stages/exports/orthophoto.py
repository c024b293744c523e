"""Intensity and colour of the map seen from above, as cloud-optimized GeoTIFFs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.exports.canvas import BLOCKS_IN_MEMORY, Canvas, blank
from scanloom.stages.exports.geotiff import Lattice, Layer, Window, write_geotiffs
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.raster import Ground, cells_in, mean_of
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.srgb import LINEAR, srgb

TOP_M = 0.3
"""Points less than this below the highest of their cell are seen from above."""
PAINTS_IN_MEMORY = 32
"""Blocks of each of red, green and blue."""
NUMBERS = 65535
"""Numbers of 16 bits but 0, which means that nothing was measured."""


def write_orthophoto(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """Mean intensity per cell: `intensity_top.tif` of what is seen from above, `intensity_ground.tif` of the ground; and where the map
    has colours, `colour_top.tif` of those seen from above.

    Intensities are 16 bit, 0 where there is nothing; intensity = offset + scale * number, with offset and scale of the band
    as GDAL keeps them: the lowest intensity (or 0) has number 1, the highest 65535. Intensities are as the sensor gave
    them: not corrected for distance or angle. Colours are sRGB of 8 bits, the mean of light, with an alpha that is 0 where nothing has any.

    Raises
    ------
    InvalidInput : the map has no points.
    UsageError : the system asked for is not known.
    """
    ground = Ground.of(source, options)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".cells-") as scratch:
        heights, top, road = (_canvas(Path(scratch) / name, ground.cell) for name in ("z", "top", "road"))
        paints = [_canvas(Path(scratch) / name, ground.cell, PAINTS_IN_MEMORY) for name in ("r", "g", "b")]
        low, high = 0.0, 0.0
        for tile, points in ground.tiles():
            heights.paint(points[:, :2], points[:, 2])
            low = min(low, float(tile.intensity.min(initial=0.0)))
            high = max(high, float(tile.intensity.max(initial=0.0)))
        lattice = ground.lattice(heights, "points")
        for tile, points in ground.tiles():
            intensity = tile.intensity.astype(np.float64)
            seen = points[:, 2] > heights.highest_at(points[:, :2]) - TOP_M
            top.paint(points[seen, :2], intensity[seen])
            on_ground = tile.class_ == PointClass.GROUND
            road.paint(points[on_ground, :2], intensity[on_ground])
            seen &= tile.views > 0
            for canvas, channel in zip(paints, tile.colour[seen].T):
                canvas.paint(points[seen, :2], LINEAR[channel])
        scale = (high - low) / (NUMBERS - 1) or 1.0
        layers = _layers(scale, low - scale) + ([] if paints[0].empty else [_PICTURE])

        def numbers(window: Window) -> list[NDArray[Any]] | None:
            if (seen := cells_in(top, lattice, window)) is None:
                return None
            ground_cells = cells_in(road, lattice, window)
            low_lying = blank(seen.shape) if ground_cells is None else ground_cells
            bands: list[NDArray[Any]] = [_numbers(part, low, scale)[::-1] for part in (seen, low_lying)]
            return bands if paints[0].empty else [*bands, _picture(paints, lattice, window)]

        return write_geotiffs(folder, lattice, layers, numbers)


def _canvas(folder: Path, cell: float, blocks: int = BLOCKS_IN_MEMORY) -> Canvas:
    folder.mkdir()
    return Canvas(folder, cell, blocks)


def _numbers(cells: NDArray[np.void], low: float, scale: float) -> NDArray[np.uint16]:
    number = 1.0 + np.rint((mean_of(cells) - low) / scale)
    return np.where(cells["count"] > 0, np.clip(number, 1, NUMBERS), 0).astype(np.uint16)


def _picture(paints: list[Canvas], lattice: Lattice, window: Window) -> NDArray[np.uint8]:
    """Red, green, blue and alpha (4, rows, columns), rows southwards."""
    out = np.zeros((4, *window[2:]), np.uint8)
    for band, canvas in enumerate(paints):
        cells = cells_in(canvas, lattice, window)
        if cells is not None:
            some = cells["count"] > 0
            out[band] = np.where(some, srgb(mean_of(cells).astype(np.float64)), 0)[::-1]
            out[3] = np.where(some, 255, 0)[::-1]
    return out


def _layers(scale: float, offset: float) -> list[Layer]:
    tags = {"INTENSITY": "as the sensor gave it, not corrected for distance or angle"}
    docs = {
        "intensity_top": f"mean intensity of the points less than {TOP_M} m below the highest",
        "intensity_ground": "mean intensity of the ground points",
    }
    return [Layer(name, "uint16", 0, "1", doc, scale, offset, tags) for name, doc in docs.items()]


_PICTURE = Layer(
    "colour_top", "uint8", 0, "", f"mean colour of the points less than {TOP_M} m below the highest, sRGB", picture=True,
    tags={"COLOUR": "brought to middle grey, shadows as they were; alpha 0 where no image saw a point"},
)  # fmt: skip
