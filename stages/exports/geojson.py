"""Trajectories as GeoJSON (RFC 7946): one feature per session, WGS84 longitude and latitude."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.frames import Georeference
from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.antimeridian import bounding_box, line_geometry
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import world_to_geodetic
from scanloom.stages.geometry.se3 import F8

DEGREE_DECIMALS, METRE_DECIMALS = 9, 4
"""A tenth of a millimetre."""


def write_geojson(source: MapSource, folder: Path, origin: Georeference) -> list[Path]:
    """`trajectory.geojson`: a line per session of longitude, latitude and height above the ellipsoid, as the RFC has it.

    A session of one scan is a point; a line across the 180th meridian is cut there.
    """
    sessions = {name: (poses, positions_of(origin, poses)) for name, poses in source.trajectories().items()}
    collection: dict[str, Any] = {"type": "FeatureCollection", "name": source.name}
    everywhere = np.vstack([np.empty((0, 3)), *(positions for _, positions in sessions.values())])
    if len(everywhere):
        collection["bbox"] = bounding_box(everywhere)
    collection["features"] = [
        {
            "type": "Feature",
            "id": name,
            "geometry": line_geometry(positions),
            "properties": _properties(name, poses),
        }
        for name, (poses, positions) in sessions.items()
    ]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "trajectory.geojson"
    path.write_text(json.dumps(collection, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    return [path]


def positions_of(origin: Georeference, poses: Poses) -> F8:
    """Longitude, latitude (degrees) and height above the ellipsoid (m) of each pose, (n, 3), rounded to 0.1 mm."""
    latitude, longitude, height = world_to_geodetic(origin, poses.T_world_lidar[:, :3, 3]).T
    degrees = np.round(np.column_stack((longitude, latitude)), DEGREE_DECIMALS)
    return np.column_stack((degrees, np.round(height, METRE_DECIMALS)))


def utc(stamp_ns: int) -> str:
    """RFC 3339, microseconds, of a stamp counted from 1970."""
    whole, part = divmod(int(stamp_ns) // 1000, 1_000_000)
    moment = datetime.fromtimestamp(0, UTC) + timedelta(seconds=whole)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{part:06d}Z"


def length_m(poses: Poses) -> float:
    """Length of the way driven, as the poses have it."""
    return float(np.linalg.norm(np.diff(poses.T_world_lidar[:, :3, 3], axis=0), axis=1).sum())


def _properties(name: str, poses: Poses) -> dict[str, Any]:
    about: dict[str, Any] = {"session": name, "scans": len(poses), "heights": "above the WGS84 ellipsoid, m"}
    if len(poses):
        start, end = int(poses.stamp_ns.min()), int(poses.stamp_ns.max())
        about |= {
            "start": utc(start),
            "end": utc(end),
            "duration_s": round((end - start) * 1e-9, 3),
            "length_m": round(length_m(poses), 3),
        }
    return about
