"""Heights of the ground as cloud-optimized GeoTIFFs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.exports.canvas import Canvas
from scanloom.stages.exports.geotiff import Lattice, Layer, Window, write_geotiffs
from scanloom.stages.exports.holes import fill_holes
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.raster import Ground, cells_in, mean_of
from scanloom.stages.exports.source import MapSource

NO_HEIGHT = -9999.0


def write_dem(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`dem.tif` mean and `dem_lowest.tif` lowest height of the ground points in a cell, `dem_count.tif` their number.

    Holes are interpolated as `holes.fill_holes` says, up to `fill_cells` away; their count is 0. What is farther away, or
    outside, holds no data.

    Raises
    ------
    InvalidInput : the map has no ground points.
    UsageError : the system asked for is not known, or its grid is not installed.
    """
    ground = Ground.of(source, options)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".cells-") as scratch:
        canvas = Canvas(Path(scratch), ground.cell)
        for tile, points in ground.tiles():
            chosen = points[tile.class_ == PointClass.GROUND]
            canvas.paint(chosen[:, :2], chosen[:, 2])
        lattice = ground.lattice(canvas, "ground points")

        def heights(window: Window) -> list[NDArray[Any]] | None:
            return _heights(canvas, lattice, window, options.fill_cells)

        return write_geotiffs(folder, lattice, _layers(ground), heights)


def _heights(canvas: Canvas, lattice: Lattice, window: Window, reach: int) -> list[NDArray[Any]] | None:
    """Mean, lowest and count of a window of the file."""
    cells = cells_in(canvas, lattice, window, reach)
    if cells is None:
        return None
    known = cells["count"] > 0
    filled, has = fill_holes(np.stack((mean_of(cells), cells["lowest"])), known, reach)
    inner = slice(reach, -reach or None)
    mean, lowest = np.where(has, filled, NO_HEIGHT)[:, ::-1]
    return [mean, lowest, cells["count"][inner, inner][::-1]]


def _layers(ground: Ground) -> list[Layer]:
    options = ground.options
    reach_m = options.fill_cells * options.cell_m
    tags = {
        "HEIGHTS": ground.projector.heights,
        "FILLED": f"holes with ground on all sides within {reach_m:g} m, weight 1 / distance^2; their count is 0",
    }
    return [
        Layer("dem", "float32", NO_HEIGHT, "m", "mean height of the ground points", tags=tags),
        Layer("dem_lowest", "float32", NO_HEIGHT, "m", "height of the lowest ground point", tags=tags),
        Layer("dem_count", "uint32", 0, "1", "number of ground points", smooth=False),
    ]
