"""GeoTIFFs written window by window: cloud-optimized, tiled, deflated, with overviews."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

TILE = 512
"""Edge of a tile inside the file, cells."""
CACHE_MB = 128


@dataclass(frozen=True)
class Layer:
    """What a raster holds and how its numbers are to be read."""

    name: str
    """Of the file, without ending, and of the band."""
    dtype: str
    nodata: float
    unit: str
    doc: str
    scale: float = 1.0
    """Value = offset + scale * number in the file."""
    offset: float = 0.0
    tags: Mapping[str, str] = field(default_factory=dict)
    smooth: bool = True
    """Overviews hold means; else one of the cells."""
    picture: bool = False
    """Red, green, blue and alpha (4, rows, columns) instead of one band; where alpha is 0 there is nothing, `nodata` is not used."""


@dataclass(frozen=True)
class Lattice:
    """Where the cells lie. Rows run southwards, as in the file; row 0 is the northernmost."""

    cell: float
    """Edge of a cell in units of the system."""
    west: int
    """Columns from the origin of the coordinate system to the left edge."""
    north: int
    """Rows from the origin of the coordinate system to the upper edge."""
    rows: int
    columns: int
    crs: str | None
    """WKT, None for local coordinates."""

    def windows(self) -> Iterator[tuple[int, int, int, int]]:
        """First row, first column, rows, columns of every tile of the file."""
        for row in range(0, self.rows, TILE):
            for column in range(0, self.columns, TILE):
                yield row, column, min(TILE, self.rows - row), min(TILE, self.columns - column)


Window = tuple[int, int, int, int]


def write_geotiffs(
    folder: Path,
    lattice: Lattice,
    layers: list[Layer],
    values: Callable[[Window], list[NDArray[Any]] | None],
) -> list[Path]:
    """One file per layer. `values` gives the layers' cells in a window, (rows, columns) or of a picture (4, rows, columns); None where
    all of them are empty.

    First a plain file with the tiles that hold something, then GDAL's COG driver makes the overviews and the order
    that can be read over a network; both work tile by tile.
    """
    import rasterio
    from rasterio.shutil import copy

    targets = [folder / f"{layer.name}.tif" for layer in layers]
    with (
        rasterio.Env(GDAL_CACHEMAX=CACHE_MB, GDAL_NUM_THREADS=1),
        tempfile.TemporaryDirectory(dir=folder, prefix=".raster-") as scratch,
    ):
        drafts = [Path(scratch) / target.name for target in targets]
        _write_drafts(drafts, lattice, layers, values)
        for draft, target, layer in zip(drafts, targets, layers, strict=True):
            copy(
                draft, target, driver="COG", COMPRESS="DEFLATE", BLOCKSIZE=TILE, OVERVIEWS="IGNORE_EXISTING",
                PREDICTOR="YES", RESAMPLING="AVERAGE" if layer.smooth else "NEAREST",
                BIGTIFF="IF_SAFER", SPARSE_OK=True,
            )  # fmt: skip
    return targets


def _write_drafts(
    drafts: list[Path],
    lattice: Lattice,
    layers: list[Layer],
    values: Callable[[Window], list[NDArray[Any]] | None],
) -> None:
    from contextlib import ExitStack

    from rasterio.windows import Window as Part

    with ExitStack() as stack:
        files = [stack.enter_context(_draft(d, lattice, x)) for d, x in zip(drafts, layers, strict=True)]
        for window in lattice.windows():
            cells = values(window)
            if cells is None:
                continue
            row, column, rows, columns = window
            for file, layer, band in zip(files, layers, cells, strict=True):
                bands = np.asarray(band, layer.dtype).reshape(-1, rows, columns)
                file.write(bands, window=Part(column, row, columns, rows))


def _draft(path: Path, lattice: Lattice, layer: Layer) -> Any:
    import rasterio
    from affine import Affine
    from rasterio.enums import ColorInterp

    cell = lattice.cell
    kind = (
        {"count": 4, "photometric": "RGB", "alpha": "YES"}
        if layer.picture
        else {"count": 1, "nodata": layer.nodata}
    )
    file = rasterio.open(
        path, "w", driver="GTiff", width=lattice.columns, height=lattice.rows, dtype=layer.dtype,
        crs=lattice.crs, tiled=True, blockxsize=TILE, blockysize=TILE, SPARSE_OK=True,
        BIGTIFF="IF_SAFER", transform=Affine(cell, 0.0, lattice.west * cell, 0.0, -cell, lattice.north * cell), **kind,
    )  # fmt: skip
    if layer.picture:
        file.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        file.update_tags(IMAGEDESCRIPTION=layer.doc)
    else:
        file.set_band_description(1, layer.doc)
        file.set_band_unit(1, layer.unit)
        file.scales, file.offsets = (layer.scale,), (layer.offset,)
    file.update_tags(AREA_OR_POINT="Area", **layer.tags)
    return file
