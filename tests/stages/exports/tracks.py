"""Small delivered maps with trajectories, anywhere on the Earth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanloom.schemas.frames import Georeference
from scanloom.schemas.scans import PointClass
from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.geometry.se3 import pose, so3_exp
from tests.delivered import cut, write_map

START_NS = 1_760_000_000_049_951_173
MUNICH, CAPE_TOWN = georeference(48.13, 11.57, 560.0), georeference(-33.92, 18.42, 40.0)
FIJI = georeference(-16.8, 179.9999, 12.0)
"""Its eastern neighbourhood lies beyond the 180th meridian."""


def poses_along(
    places: np.ndarray, origin: Georeference | None, *, start_ns: int = START_NS, yaw_rad: float = 0.5
) -> Poses:
    """Poses at places (n, 3), ten a second; all look the same way and are surest along their own x."""
    n = len(places)
    T = np.array([pose(so3_exp([0.0, 0.0, yaw_rad]), p) for p in places]).reshape(n, 4, 4)
    variances = np.array([1e-6, 2e-6, 4e-6, 0.01, 0.04, 0.09])
    return Poses(
        scan_index=np.arange(n), stamp_ns=start_ns + 100_000_000 * np.arange(n), T_world_lidar=T,
        covariance=np.tile(np.diag(variances), (n, 1, 1)), keyframe=np.arange(n) % 5 == 0,
        frame="world" if origin else "map", georeference=origin.model_dump() if origin else None,
    )  # fmt: skip


def way(n: int, *, turn: float = 0.0) -> np.ndarray:
    """A bent way of n places, five metres apart, heading east and `turn` to the left."""
    along = 5.0 * np.arange(n)
    bent = np.column_stack((along, 0.002 * along**2, 1.7 + 0.01 * along))
    c, s = np.cos(turn), np.sin(turn)
    return bent @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def plane(
    n: int = 40_000, *, size_m: float = 60.0, slope: tuple[float, float] = (0.05, -0.02), seed: int = 0
) -> np.ndarray:
    """Points (n, 3) of a tilted plane around the origin: tiles on all four sides of it."""
    x, y = np.random.default_rng(seed).uniform(-size_m / 2.0, size_m / 2.0, (2, n))
    return np.column_stack((x, y, slope[0] * x + slope[1] * y))


def delivered(
    folder: Path,
    origin: Georeference | None,
    sessions: dict[str, Poses],
    points: np.ndarray | None = None,
    *,
    class_: int = int(PointClass.GROUND),
    columns: dict[str, np.ndarray] | None = None,
) -> MapSource:
    """A map folder with tiles and trajectories, opened."""
    fields = origin.model_dump() if origin else None
    cloud = plane() if points is None else points
    each = {"class_": np.full(len(cloud), class_, np.uint8)} | (columns or {})
    write_map(
        folder,
        cut(cloud, georeference=fields, sessions=tuple(sessions) or ("a",), columns=each),
        sessions=[{"name": name} for name in sessions],
    )
    if len(sessions) == 1:
        next(iter(sessions.values())).write(folder / "trajectory.parquet")
    for name, poses in sessions.items() if len(sessions) > 1 else ():
        (folder / "trajectory").mkdir(exist_ok=True)
        poses.write(folder / "trajectory" / f"{name}.parquet")
    return MapSource.open(folder)
