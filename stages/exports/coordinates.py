"""From the map's frame into the coordinate system of an export: exact, or proven to be within a hundredth of a millimetre."""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.schemas.frames import Georeference
from scanloom.schemas.tiles import Tile
from scanloom.stages.exports.options import ELLIPSOIDAL, ORTHOMETRIC, Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import world_to_geodetic

F8 = NDArray[np.float64]

TOLERANCE_M = 1e-5
"""Largest difference between a polynomial and PROJ that is taken for nothing; exports keep whole millimetres."""
WORTH_A_FIT = 2000
"""PROJ is asked for fewer points than these one by one."""
_WGS84_3D = 4979
_AROUND_DEG = 0.01


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

    @property
    def heights(self) -> str:
        """What heights are counted from, in words."""
        if self.epsg is None:
            return "above the origin of the map's own frame, m"
        if self.vertical_epsg is None:
            return f"above the {self._ellipsoid} ellipsoid, m"
        from pyproj import CRS

        return f"above the geoid, {CRS.from_epsg(self.vertical_epsg).name} (EPSG:{self.vertical_epsg})"

    @property
    def height_kind(self) -> str:
        """`ellipsoidal`, `orthometric`, or `local` for a map without georeference."""
        if self.epsg is None:
            return "local"
        return ELLIPSOIDAL if self.vertical_epsg is None else ORTHOMETRIC

    @property
    def _ellipsoid(self) -> str:
        """Name without the space that EPSG writes into `WGS 84`."""
        return str(self.crs.ellipsoid.name).replace("WGS 84", "WGS84")

    @cached_property
    def crs(self) -> Any:
        """`pyproj.CRS` with three axes, or None."""
        if self.epsg is None:
            return None
        if self.vertical_epsg is None:
            return _horizontal(self.epsg).to_3d()
        return _compound(self.epsg, self.vertical_epsg)

    @cached_property
    def plain_crs(self) -> Any:
        """`crs` as programs know it by its code, or None: no projected system with heights above the ellipsoid has one,
        so that then only the plane is given; `heights` says the rest."""
        if self.crs is None or self.crs.is_compound:
            return self.crs
        return self.crs.to_2d()

    @cached_property
    def wkt(self) -> str:
        """The system as OGC WKT 1, which LAS 1.4 asks for; empty without a georeference.

        WKT 1 has no three-dimensional projected systems: heights above the ellipsoid are written as a vertical system of
        type 2002, as PROJ and GDAL do, who read the three-dimensional system back.
        """
        if self.epsg is None:
            return ""
        horizontal = _horizontal(self.epsg)
        plane = str(horizontal.to_wkt("WKT1_GDAL"))
        if self.vertical_epsg is not None:
            return str(self.crs.to_wkt("WKT1_GDAL"))
        return (
            f'COMPD_CS["{horizontal.name} + Ellipsoid (metre)",{plane},VERT_CS["Ellipsoid (metre)",'
            'VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Ellipsoidal height",UP]]]'
        )

    @cached_property
    def operation(self) -> dict[str, Any]:
        """How PROJ gets there: its words, and the accuracy it states, m (0 for the map's own datum)."""
        if self.epsg is None:
            return {}
        return {"description": self._transformer.description, "accuracy_m": self._transformer.accuracy}

    def project(self, points: ArrayLike) -> F8:
        """x, y, height (n, 3) of points (n, 3) of the map's frame, m; exact.

        Raises
        ------
        UsageError : the map reaches beyond what the system or its grid covers.
        """
        from pyproj.exceptions import ProjError

        p = np.asarray(points, float).reshape(-1, 3)
        if self.georeference is None:
            return p.copy()
        geodetic = world_to_geodetic(self.georeference, p)
        try:
            found = self._transformer.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2], errcheck=True)
        except ProjError as error:
            raise _outside(self, error) from error
        return np.column_stack(found)

    def tile(self, tile: Tile) -> F8:
        """x, y, height (n, 3) of the points of a tile, to `TOLERANCE_M`."""
        points = np.empty((len(tile), 3))
        for axis, column in enumerate((tile.x_m, tile.y_m, tile.z_m)):
            np.add(column, tile.offset_m[axis], out=points[:, axis], dtype=np.float64)
        if self.georeference is None or len(points) < WORTH_A_FIT:
            return self.project(points)
        patch = Patch.fit(self, points.min(axis=0), points.max(axis=0))
        return self.project(points) if patch.residual_m > TOLERANCE_M else patch(points)

    def corners(self, low: ArrayLike, high: ArrayLike) -> F8:
        """The eight corners (8 n, 3) of boxes (n, 3) of the map's frame, m."""
        box = np.atleast_2d(low), np.atleast_2d(high)
        picks = itertools.product(box, repeat=3)
        return self.project(
            np.concatenate([np.column_stack((x[:, 0], y[:, 1], z[:, 2])) for x, y, z in picks])
        )

    def axes(self, place: ArrayLike) -> F8:
        """Rotation (3, 3) of directions of the map's frame at a place (3,) into the export's axes: mostly grid convergence."""
        if self.georeference is None:
            return np.eye(3)
        around = np.asarray(place, float) + np.concatenate((np.zeros((1, 3)), np.eye(3)))
        moved = self.project(around)
        u, _, v = np.linalg.svd((moved[1:] - moved[0]).T)
        return np.asarray(u @ v)

    @cached_property
    def _transformer(self) -> Any:
        """Raises
        ------
        UsageError : PROJ knows no exact way to the system, or the way needs a grid that is not there.
        """
        from pyproj.transformer import AreaOfInterest, TransformerGroup

        if self.georeference is None:
            return None
        latitude, longitude = self.georeference.latitude_deg, self.georeference.longitude_deg
        around = AreaOfInterest(
            longitude - _AROUND_DEG, latitude - _AROUND_DEG, longitude + _AROUND_DEG, latitude + _AROUND_DEG
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            ways = TransformerGroup(_WGS84_3D, self.crs, always_xy=True, area_of_interest=around)
        if not ways.best_available:
            raise _grid_is_missing(self, ways.unavailable_operations)
        if not ways.transformers or ways.transformers[0].accuracy < 0:
            raise UsageError(
                f"there is no transformation of known accuracy from WGS84 to EPSG:{self.epsg} at {latitude:.3f}, {longitude:.3f}",
                next_step="take a system whose area of use holds the map",
            )
        return ways.transformers[0]


@dataclass(frozen=True)
class Patch:
    """A polynomial of second degree that stands for a `Projector` within a box."""

    middle: F8
    half: F8
    coefficients: F8
    """(10, 3)"""
    residual_m: float
    """Largest difference to PROJ at 5 x 5 x 5 points of the box, corners and middle among them, none of the fit's own."""

    CHUNK = 1 << 15
    """Points at a time, so that their powers stay in the cache."""

    @classmethod
    def fit(cls, projector: Projector, low: F8, high: F8) -> Patch:
        """Least squares over 4 x 4 x 4 Chebyshev points of the box, which spread the remainder evenly."""
        middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-3)
        nodes = np.cos((2.0 * np.arange(4) + 1.0) * np.pi / 8.0)
        at = np.array(list(itertools.product(nodes, repeat=3)))
        coefficients = np.asarray(
            np.linalg.lstsq(_terms(at), projector.project(middle + half * at), rcond=None)[0], np.float64
        )
        check = np.array(list(itertools.product(np.linspace(-1.0, 1.0, 5), repeat=3)))
        wrong = _terms(check) @ coefficients - projector.project(middle + half * check)
        return cls(middle, half, coefficients, float(np.abs(wrong).max()))

    def __call__(self, points: F8) -> F8:
        out = np.empty_like(points)
        for start in range(0, len(points), self.CHUNK):
            rows = slice(start, start + self.CHUNK)
            out[rows] = _terms((points[rows] - self.middle) / self.half) @ self.coefficients
        return out


def _terms(u: F8) -> F8:
    """1, x, y, z, xx, yy, zz, xy, xz, yz (n, 10)."""
    x, y, z = u.T
    return np.column_stack((np.ones(len(u)), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z))


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
            f"EPSG:{epsg} ({found.name}) is no projected system of the plane, and clouds need lengths along their axes",
            next_step="give a projected one, for instance the UTM zone; heights are chosen by --heights and --vertical-epsg",
        )
    return found


def _compound(epsg: int, vertical_epsg: int) -> Any:
    """The projected system with heights of a vertical one.

    Raises
    ------
    UsageError : one of the codes is no such system.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    _horizontal(epsg)
    try:
        vertical = CRS.from_epsg(vertical_epsg)
    except CRSError as error:
        raise UsageError(
            f"there is no EPSG:{vertical_epsg}", next_step="see epsg.io for the codes"
        ) from error
    if not vertical.is_vertical or vertical.is_compound:
        raise UsageError(
            f"EPSG:{vertical_epsg} ({vertical.name}) is no system of heights",
            next_step="give a vertical one: 5773 (EGM96), 3855 (EGM2008), or the national one",
        )
    return CRS(f"EPSG:{epsg}+{vertical_epsg}")


def _outside(projector: Projector, error: Exception) -> UsageError:
    origin = projector.georeference
    place = f" near {origin.latitude_deg:.3f}, {origin.longitude_deg:.3f}" if origin else ""
    target = f"EPSG:{projector.epsg}" + (f"+{projector.vertical_epsg}" if projector.vertical_epsg else "")
    return UsageError(
        f"PROJ cannot convert points of the map{place} into {target}: {error}",
        next_step="take a system whose area and grid cover the map, or --heights ellipsoidal",
    )


def _grid_is_missing(projector: Projector, operations: list[Any]) -> UsageError:
    from pyproj.datadir import get_user_data_dir  # type: ignore[attr-defined]

    grids = [grid for grid in operations[0].grids if not grid.available] if operations else []
    names = ", ".join(grid.short_name for grid in grids) or "one that PROJ does not name"
    target = f"EPSG:{projector.epsg}" + (f"+{projector.vertical_epsg}" if projector.vertical_epsg else "")
    sync = "; ".join(f"pyproj sync --file {grid.short_name}" for grid in grids) or "pyproj sync --help"
    where = " and ".join(grid.url for grid in grids if grid.url) or "https://cdn.proj.org"
    return UsageError(
        f"the way from WGS84 to {target} needs a grid that is not installed: {names}",
        next_step=(
            f"run `{sync}` where there is a network, or put it into {get_user_data_dir()} (from {where}); "
            "--heights ellipsoidal needs no grid"
        ),
    )
