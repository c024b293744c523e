"""What formats in longitude and latitude share: where the map stands, positions, times."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import ArrayLike

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.frames import Georeference
from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import world_to_geodetic
from scanloom.stages.geometry.se3 import F8

DEGREE_DECIMALS, METRE_DECIMALS = 9, 4
"""A tenth of a millimetre."""


def origin_of(source: MapSource, format_name: str) -> Georeference:
    """Where the map's frame stands on the Earth.

    Raises
    ------
    InvalidInput : nobody knows.
    """
    if source.georeference is None:
        raise InvalidInput(
            f"has no georeference, and {format_name} knows only places on the Earth: its log had no usable GNSS",
            where=str(source.folder),
            next_step=f"leave {format_name} out of --format; tum, kitti and geoparquet take the map's own coordinates",
        )
    return source.georeference


def geodetic(origin: Georeference, points: ArrayLike) -> F8:
    """Longitude, latitude (degrees) and height above the ellipsoid (m) of points (n, 3) of the map, rounded to 0.1 mm."""
    latitude, longitude, height = world_to_geodetic(origin, points).T
    degrees = np.round(np.column_stack((longitude, latitude)), DEGREE_DECIMALS)
    return np.column_stack((degrees, np.round(height, METRE_DECIMALS)))


def places(poses: Poses) -> F8:
    """Positions of the LiDAR (n, 3) in the map's frame, m."""
    return np.asarray(poses.T_world_lidar[:, :3, 3], float)


def moment(stamp_ns: int) -> datetime:
    """A stamp counted from 1970, to the microsecond."""
    return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=int(stamp_ns) // 1000)


def utc(stamp_ns: int) -> str:
    """The same as RFC 3339 has it."""
    return f"{moment(stamp_ns):%Y-%m-%dT%H:%M:%S.%f}Z"
