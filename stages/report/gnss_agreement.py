"""GNSS fixes beside the map's poses: where they lie, and how far apart the two are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.schemas.frames import Georeference
from scanloom.schemas.product import Parts
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry.geodesy import geodetic_to_world
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8, inverse


@dataclass(frozen=True)
class Agreement:
    """Fixes in the map's frame (n, 3), m, and their horizontal distance (m,) to the antenna, m."""

    fixes: F8
    distance_m: F8

    @property
    def median_m(self) -> float | None:
        return float(np.median(self.distance_m)) if len(self.distance_m) else None


def gnss_agreement(gnss: Gnss, poses: Poses, session: Session) -> Agreement:
    """Fixes of a session against its optimised poses; empty without fixes or georeference.

    The antenna stands at T_world_lidar T_lidar_base T_base_gnss. Fixes outside the time of the poses are shown, not
    compared.
    """
    fixed = (gnss.status >= 0) & np.isfinite(gnss.latitude_deg) & np.isfinite(gnss.longitude_deg)
    if poses.georeference is None or not fixed.any():
        return Agreement(np.empty((0, 3)), np.empty(0))
    origin = Georeference(**poses.georeference)
    height = np.nan_to_num(gnss.height_m[fixed], nan=origin.height_m)
    fixes = geodetic_to_world(origin, gnss.latitude_deg[fixed], gnss.longitude_deg[fixed], height)
    stamps = gnss.stamp_ns[fixed]
    covered = inside(poses.stamp_ns, stamps)
    if not covered.any():
        return Agreement(fixes, np.empty(0))
    T_lidar_gnss = inverse(np.array(session.T_base("lidar"))) @ np.array(session.T_base("gnss"))
    antenna = interpolate_poses(poses.stamp_ns, poses.T_world_lidar, stamps[covered]) @ T_lidar_gnss
    return Agreement(fixes, np.linalg.norm((fixes[covered] - antenna[:, :3, 3])[:, :2], axis=1))


def gnss_agreements(
    sessions: dict[str, Session], paths: dict[str, Poses], gnss: Parts[Gnss]
) -> dict[str, Agreement]:
    """`gnss_agreement` of every session that has poses and fixes."""
    fixes = {c["session"]: g for c, g in gnss.items()}
    return {name: gnss_agreement(fixes[name], paths[name], sessions[name]) for name in paths if name in fixes}
