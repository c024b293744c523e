"""Rasters of the map: heights of the ground, and the intensity seen from above, as cloud-optimized GeoTIFFs.

Every point is projected by itself and counted in the cell it falls into: the tiles of the map lie askew to the grid of
the projection (by the convergence of the meridians), and a raster turned from one to the other would be blurred.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import UsageError
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import Tile
from scanloom.stages.exports.canvas import Canvas
from scanloom.stages.exports.geotiff import Lattice, Layer, Window, write_geotiffs
from scanloom.stages.exports.holes import fill_holes
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.se3 import F8

CELL_M = 0.25
FILL_M = 1.0
TOP_M = 0.3
NO_HEIGHT = -9999.0
LARGEST_NUMBER = 65535
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Place:
    """How coordinates of the map become those of the raster."""

    project: Callable[[F8], F8]
    crs: str | None
    heights: str
    """What heights are counted from, in words."""


def write_dem(
    source: MapSource, folder: Path, place: Place, cell_m: float = CELL_M, fill_m: float = FILL_M
) -> list[Path]:
    """Heights of the ground: `dem.tif` mean, `dem_lowest.tif` lowest, `dem_count.tif` points per cell.

    Cells without a ground point get the distance-weighted mean of those around them, up to `fill_m` away
    (`holes.fill_holes`); their count is 0. What is farther away, or outside, holds no data.

    Raises
    ------
    UsageError : the map has no ground points.
    """
    reach = round(fill_m / cell_m)
    tags = {
        "HEIGHTS": place.heights,
        "FILLED": f"holes up to {fill_m:g} m from ground on all sides, weight 1 / distance^2; their count is 0",
    }
    layers = [
        Layer("dem", "float32", NO_HEIGHT, "m", "mean height of the ground points in the cell", tags=tags),
        Layer("dem_lowest", "float32", NO_HEIGHT, "m", "height of the lowest ground point in the cell", tags=tags),
        Layer("dem_count", "uint32", 0, "1", "ground points in the cell", smooth=False),
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".cells-") as scratch:
        canvas = Canvas(Path(scratch), cell_m)
        for tile, points in _projected(source, place):
            ground = tile.class_ == PointClass.GROUND
            canvas.paint(points[ground, :2], points[ground, 2])
        lattice = _lattice(canvas, place, "ground points", source)

        def heights(window: Window) -> list[NDArray[Any]] | None:
            cells = _cells(canvas, lattice, window, reach)
            known = cells["count"] > 0
            if not known.any():
                return None
            bands = []
            for values in (_mean(cells), cells["lowest"]):
                filled, has = fill_holes(values, known, reach)
                bands.append(np.where(has, filled, NO_HEIGHT)[::-1])
            return [*bands, _inner(cells, reach)["count"][::-1]]

        return write_geotiffs(folder, lattice, layers, heights)


def write_intensity(source: MapSource, folder: Path, place: Place, cell_m: float = CELL_M) -> list[Path]:
    """Mean intensity per cell: `intensity_ground.tif` of the ground, `intensity_top.tif` of what is seen from above.

    Seen from above are the points less than 0.3 m below the highest of their cell. Numbers are 16 bit, 0 where nothing
    was measured; the file says how intensities follow from them (GDAL's scale and offset of a band).

    Raises
    ------
    UsageError : the map has no points.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".cells-") as scratch:
        parts = [Path(scratch) / part for part in ("heights", "ground", "top")]
        for part in parts:
            part.mkdir()
        tops, ground, top = (Canvas(part, cell_m) for part in parts)
        low, high = 0.0, 0.0
        for tile, points in _projected(source, place):
            tops.paint(points[:, :2], points[:, 2])
            low = min(low, float(tile.intensity.min(initial=0.0)))
            high = max(high, float(tile.intensity.max(initial=0.0)))
        lattice = _lattice(tops, place, "points", source)
        for tile, points in _projected(source, place):
            seen = points[:, 2] >= tops.highest_at(tops.cells_of(points[:, :2])) - TOP_M
            on_ground = tile.class_ == PointClass.GROUND
            top.paint(points[seen, :2], tile.intensity[seen].astype(float))
            ground.paint(points[on_ground, :2], tile.intensity[on_ground].astype(float))
        scale = (high - low) / (LARGEST_NUMBER - 1) or 1.0

        def numbers(window: Window) -> list[NDArray[Any]] | None:
            bands = []
            for canvas in (ground, top):
                cells = _cells(canvas, lattice, window, 0)
                number = 1.0 + np.rint((_mean(cells) - low) / scale)
                bands.append(np.where(cells["count"] > 0, number, 0.0)[::-1])
            return bands if any(band.any() for band in bands) else None

        shared = {"scale": scale, "offset": low - scale}
        layers = [
            Layer("intensity_ground", "uint16", 0, "1", "mean intensity of the ground points", **shared),
            Layer("intensity_top", "uint16", 0, "1", "mean intensity of the topmost points", **shared),
        ]
        return write_geotiffs(folder, lattice, layers, numbers)


def _projected(source: MapSource, place: Place) -> Iterator[tuple[Tile, F8]]:
    """Each tile with its points (n, 3) in the raster's coordinates."""
    for _, tile in source.tiles():
        local = np.column_stack((tile.x_m, tile.y_m, tile.z_m)).astype(np.float64)
        yield tile, place.project(local + np.asarray(tile.offset_m))


def _lattice(canvas: Canvas, place: Place, of_what: str, source: MapSource) -> Lattice:
    if canvas.empty:
        raise UsageError(
            f"has no {of_what}, of which a raster could be made",
            where=str(source.folder),
            next_step="leave this format out of --format",
        )
    row, column, rows, columns = canvas.extent
    return Lattice(canvas.cell_m, column, row + rows, rows, columns, place.crs)


def _cells(canvas: Canvas, lattice: Lattice, window: Window, margin: int) -> NDArray[np.void]:
    """Cells of a window of the file and of a margin around it, row by row northwards."""
    row, column, rows, columns = window
    south = lattice.north - row - rows
    return canvas.window(
        south - margin, lattice.west + column - margin, rows + 2 * margin, columns + 2 * margin
    )


def _inner(cells: NDArray[np.void], margin: int) -> NDArray[np.void]:
    return cells[margin : cells.shape[0] - margin, margin : cells.shape[1] - margin]


def _mean(cells: NDArray[np.void]) -> NDArray[np.float32]:
    return (cells["sum"] / np.maximum(cells["count"], 1)).astype(np.float32)
