"""A made-up geoid under the name of EGM96, so that orthometric heights can be tested without a download."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyproj

UNDULATION_M = 47.25
"""Everywhere the same."""


@contextmanager
def made_up_egm96(folder: Path, west_deg: float = -180.5, columns: int = 361) -> Iterator[None]:
    """PROJ finds a grid of one undulation as long as this lasts; the whole Earth, or what lies east of `west_deg`.

    Its columns are one degree wide, their middles half a degree from the edges.
    """
    import rasterio
    from rasterio.transform import from_origin

    path = folder / "us_nga_egm96_15.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=181, count=1, dtype="float32", crs="EPSG:4326",
        transform=from_origin(west_deg, 90.5, 1.0, 1.0),
    ) as grid:  # fmt: skip
        grid.update_tags(
            AREA_OR_POINT="Point", TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", target_crs_epsg_code="5773"
        )
        grid.set_band_description(1, "geoid_undulation")
        grid.set_band_unit(1, "metre")
        grid.write(np.full((181, columns), UNDULATION_M, np.float32), 1)
    before = pyproj.datadir.get_data_dir()
    pyproj.datadir.append_data_dir(str(folder))
    try:
        yield
    finally:
        pyproj.datadir.set_data_dir(before)
