"""Rasters of the map: every point is projected by itself and counted in the cell it falls into.

The tiles of the map lie askew to the grid of the projection, by the convergence of the meridians: a raster of each tile,
turned into that grid, would be blurred and have seams.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.tiles import Tile
from scanloom.stages.exports.canvas import Canvas
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.geotiff import Lattice, Window
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.se3 import F8

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Ground:
    """The map as rasters see it: its points in the plane of the projection."""

    source: MapSource
    projector: Projector
    options: Options

    @classmethod
    def of(cls, source: MapSource, options: Options) -> Ground:
        """
        Raises
        ------
        UsageError : the system asked for is not known, or its grid is not installed.
        """
        if source.georeference is None:
            log.info("%s has no georeference: its rasters keep the map's own axes", source.name)
        return cls(source, Projector.of(source, options), options)

    @cached_property
    def cell(self) -> float:
        """Edge of a cell in units of the system, which are feet for a few."""
        if self.projector.crs is None:
            return self.options.cell_m
        return self.options.cell_m / float(self.projector.crs.axis_info[0].unit_conversion_factor)

    def tiles(self) -> Iterator[tuple[Tile, F8]]:
        """Each tile with its points (n, 3) in the system, one after the other."""
        for _, tile in self.source.tiles():
            yield tile, self.projector.tile(tile)

    def lattice(self, canvas: Canvas, of_what: str) -> Lattice:
        """The cells that were painted.

        Raises
        ------
        InvalidInput : there are none.
        """
        if canvas.empty:
            raise InvalidInput(
                f"has no {of_what}, of which a raster could be made",
                where=str(self.source.folder),
                next_step="leave this format out of --format",
            )
        row, column, rows, columns = canvas.extent
        crs = self.projector.plain_crs
        return Lattice(canvas.cell, column, row + rows, rows, columns, None if crs is None else crs.to_wkt())


def cells_in(canvas: Canvas, lattice: Lattice, window: Window, margin: int = 0) -> NDArray[np.void] | None:
    """Cells of a window of the file and of a margin around it, rows northwards; None where nothing is near."""
    row, column, rows, columns = window
    south = lattice.north - row - rows
    wide = (south - margin, lattice.west + column - margin, rows + 2 * margin, columns + 2 * margin)
    return canvas.window(*wide) if canvas.holds(*wide) else None


def mean_of(cells: NDArray[np.void]) -> NDArray[np.float32]:
    """Mean of the values in each cell, 0 where there are none."""
    return np.asarray(cells["sum"] / np.maximum(cells["count"], 1), np.float32)
