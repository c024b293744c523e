"""Geodesy: WGS84, the local frame `world` (east, north, up) and projected coordinates (UTM).

All transformations are PROJ's; nothing is approximated by a plane. Heights are above the WGS84 ellipsoid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scanloom.schemas.errors import StageError
from scanloom.schemas.frames import Georeference
from scanloom.stages.geometry.se3 import F8, pose

WGS84_SEMI_MAJOR_M = 6378137.0
WGS84_ECCENTRICITY_SQUARED = 6.69437999014e-3


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code of the WGS84 / UTM zone of a place: 326zz in the north, 327zz in the south.

    Zones are 6 degrees wide; south-west Norway and Svalbard have their customary exceptions.

    Raises
    ------
    StageError : the latitude or longitude is no position on the Earth, or lies outside UTM (80 S to 84 N).
    """
    if not (-80.0 <= latitude_deg <= 84.0 and -180.0 <= longitude_deg <= 360.0):
        raise StageError(
            f"latitude {latitude_deg}, longitude {longitude_deg} has no UTM zone",
            next_step="check the GNSS positions of the log; UTM reaches from 80 S to 84 N",
        )
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    zone = min(int((longitude + 180.0) // 6.0) + 1, 60)
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 + 2 * int((longitude + 3.0) // 12.0)
    return (32600 if latitude_deg >= 0.0 else 32700) + zone


def georeference(
    latitude_deg: float, longitude_deg: float, height_m: float, epsg: int | None = None
) -> Georeference:
    """The frame `world` with its origin at a WGS84 position, in UTM or in the given projected system.

    `point_scale` takes lengths at the origin's own height to the map plane: the projection's scale on the ellipsoid
    times R / (R + h), with R the Gaussian mean radius.
    """
    from pyproj import Proj

    code = utm_epsg(latitude_deg, longitude_deg) if epsg is None else epsg
    projection = Proj(f"EPSG:{code}")
    easting, northing = projection(longitude_deg, latitude_deg)
    factors = projection.get_factors(longitude_deg, latitude_deg)
    radius = _mean_radius_m(latitude_deg)
    return Georeference(
        epsg=code,
        latitude_deg=float(latitude_deg),
        longitude_deg=float(longitude_deg),
        height_m=float(height_m),
        easting_m=float(easting),
        northing_m=float(northing),
        grid_convergence_rad=float(np.radians(factors.meridian_convergence)),
        point_scale=float(np.sqrt(factors.areal_scale) * radius / (radius + height_m)),
    )


def geodetic_to_world(
    origin: Georeference, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike
) -> F8:
    """Points (n, 3) of `world`, m, of WGS84 positions (n,), deg and m."""
    lat, lon, h = (np.atleast_1d(np.asarray(a, float)) for a in (latitude_deg, longitude_deg, height_m))
    return np.column_stack(_topocentric(origin).transform(lon, lat, h))


def world_to_geodetic(origin: Georeference, points: ArrayLike) -> F8:
    """Latitude deg, longitude deg, height m (n, 3) of points (n, 3) of `world`, m."""
    p = np.asarray(points, float).reshape(-1, 3)
    lon, lat, h = _topocentric(origin).transform(p[:, 0], p[:, 1], p[:, 2], direction="INVERSE")
    return np.column_stack((lat, lon, h))


def ecef_pose(origin: Georeference) -> F8:
    """T_ecef_world (4, 4): the frame `world` in geocentric coordinates of WGS84 (EPSG:4978), m.

    Exact. The columns are the directions east, north and up at the origin.
    """
    from pyproj import Transformer

    lat, lon = np.radians(origin.latitude_deg), np.radians(origin.longitude_deg)
    geocentric = Transformer.from_pipeline("+proj=pipeline +step +proj=cart +ellps=WGS84")
    east = (-np.sin(lon), np.cos(lon), 0.0)
    north = (-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat))
    up = (np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat))
    place = geocentric.transform(lon, lat, origin.height_m, radians=True)
    return pose(np.column_stack((east, north, up)), np.array(place))


def between_worlds(target: Georeference, source: Georeference) -> F8:
    """T_target_source (4, 4) between two frames `world`; exact, since both are Cartesian."""
    if target == source:
        return np.eye(4)
    corners = np.concatenate((np.zeros((1, 3)), 1000.0 * np.eye(3)))
    moved = geodetic_to_world(target, *world_to_geodetic(source, corners).T)
    return pose((moved[1:] - moved[0]).T / 1000.0, moved[0])


def world_to_projected(origin: Georeference, points: ArrayLike) -> F8:
    """Easting, northing in `origin.epsg` and ellipsoidal height, m (n, 3), of points (n, 3) of `world`, m; exact."""
    from pyproj import Proj

    geodetic = world_to_geodetic(origin, points)
    easting, northing = Proj(f"EPSG:{origin.epsg}")(geodetic[:, 1], geodetic[:, 0])
    return np.column_stack((easting, northing, geodetic[:, 2]))


def projected_to_world(origin: Georeference, points: ArrayLike) -> F8:
    """Inverse of `world_to_projected`."""
    from pyproj import Proj

    p = np.asarray(points, float).reshape(-1, 3)
    lon, lat = Proj(f"EPSG:{origin.epsg}")(p[:, 0], p[:, 1], inverse=True)
    return geodetic_to_world(origin, lat, lon, p[:, 2])


def _topocentric(origin: Georeference) -> Any:
    """PROJ pipeline from (longitude, latitude) in degrees and height to east, north, up at the origin."""
    from pyproj import Transformer

    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={origin.longitude_deg!r} +lat_0={origin.latitude_deg!r} "
        f"+h_0={origin.height_m!r}"
    )


def _mean_radius_m(latitude_deg: float) -> float:
    """Gaussian mean radius of curvature sqrt(M N) of the WGS84 ellipsoid, m."""
    w = 1.0 - WGS84_ECCENTRICITY_SQUARED * np.sin(np.radians(latitude_deg)) ** 2
    return float(WGS84_SEMI_MAJOR_M * np.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED) / w)
