"""From the map's frame into the coordinate system of an export: exact, or proven to be within a hundredth of a millimetre."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.schemas.frames import Georeference
from scanloom.stages.exports.options import ORTHOMETRIC, Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import world_to_geodetic

F8 = NDArray[np.float64]

TOLERANCE_M = 1e-5
"""Largest difference between a polynomial and PROJ that is taken for nothing; exports keep whole millimetres."""
_WGS84_3D = 4979


@dataclass(frozen=True)
class Projector:
    """Points of the map's frame as (x, y, height) of a projected system, x to the east.

    Without a georeference the frame's own coordinates are given, and there is no CRS.
    """

    georeference: Georeference | None
    epsg: int | None
    """The horizontal system; None without a georeference."""
    vertical_epsg: int | None
    """The system of orthometric heights; None for heights above the ellipsoid."""

    @classmethod
    def of(cls, source: MapSource, options: Options) -> Projector:
        """
        Raises
        ------
        InvalidInput : a system is asked for, and the map has no georeference.
        UsageError : the system cannot hold a point cloud, is not known, or its grid is not installed.
        """
        georeference = source.georeference
        orthometric = options.heights == ORTHOMETRIC
        if georeference is None:
            if options.epsg is not None or orthometric:
                raise InvalidInput(
                    "has no georeference: its log had no usable GNSS",
                    where=str(source.folder),
                    next_step="export without --epsg and --heights; coordinates are then the map's own",
                )
            return cls(None, None, None)
        vertical = options.vertical_epsg if orthometric else None
        projector = cls(georeference, options.epsg or georeference.epsg, vertical)
        projector.project(np.zeros((1, 3)))
        return projector

    @cached_property
    def crs(self) -> Any:
        """`pyproj.CRS` with three axes, or None."""
        if self.epsg is None:
            return None
        from pyproj import CRS

        horizontal = _horizontal(self.epsg)
        if self.vertical_epsg is None:
            return horizontal.to_3d()
        return CRS(f"EPSG:{self.epsg}+{self.vertical_epsg}")

    @property
    def heights(self) -> str:
        """What heights are counted from, in words."""
        if self.epsg is None:
            return "above the origin of the map's own frame, m"
        if self.vertical_epsg is None:
            return "above the WGS84 ellipsoid, m"
        from pyproj import CRS

        return f"above the geoid, {CRS.from_epsg(self.vertical_epsg).name} (EPSG:{self.vertical_epsg})"

    def project(self, points: ArrayLike) -> F8:
        """x, y, height (n, 3) of points (n, 3) of the map's frame, m; exact."""
        p = np.asarray(points, float).reshape(-1, 3)
        if self.georeference is None:
            return p.copy()
        geodetic = world_to_geodetic(self.georeference, p)
        return np.column_stack(self._transformer.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]))

    @cached_property
    def _transformer(self) -> Any:
        from pyproj import Transformer

        return Transformer.from_crs(_WGS84_3D, self.crs, always_xy=True)


def _horizontal(epsg: int) -> Any:
    """The projected system of a code.

    Raises
    ------
    UsageError : there is none, or it is no projected one.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        found = CRS.from_epsg(epsg)
    except CRSError as error:
        raise UsageError(f"there is no EPSG:{epsg}", next_step="see epsg.io for the codes") from error
    if not found.is_projected or found.is_compound:
        raise UsageError(
            f"EPSG:{epsg} ({found.name}) is no projected system in the plane",
            next_step="give a projected one, for instance the UTM zone; heights are chosen by --heights",
        )
    return found
