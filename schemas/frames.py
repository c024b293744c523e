"""Frames and the georeference of a map.

`world` is local east-north-up with a known origin, `map` has the same axes without georeference; `base` is the
vehicle (x forward, y left, z up); `lidar`, `imu`, `gnss` are the sensors. `T_a_b` maps coordinates of b into a.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

WORLD = "world"
MAP = "map"
BASE = "base"
LIDAR = "lidar"
IMU = "imu"
GNSS = "gnss"


class Georeference(BaseModel):
    """Where the local east-north-up frame `world` stands on the Earth.

    A point (e, n, u) of `world` near the origin has projected coordinates
    `(easting_m, northing_m) + point_scale * R(grid_convergence_rad) @ (e, n)` in `epsg` (R counter-clockwise)
    to within a centimetre per kilometre; `stages.geometry.geodesy` has the exact transformation.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    epsg: int
    """EPSG code of the projected system (WGS84 / UTM zone) in which `easting_m`, `northing_m` are given."""
    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Height above the WGS84 ellipsoid."""
    easting_m: float
    northing_m: float
    grid_convergence_rad: float
    """Angle from true north to grid north, clockwise positive."""
    point_scale: float
    """Map length over true length at the origin's own height."""
