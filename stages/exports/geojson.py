"""Trajectories as GeoJSON (RFC 7946): one feature per session, WGS84 longitude and latitude."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.antimeridian import bounding_box, line_geometry
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.wgs84 import geodetic, origin_of, places, utc


def write_geojson(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`trajectory.geojson`: a line per session of longitude, latitude and height above the ellipsoid.

    The RFC leaves no choice of system and heights. A session of one scan is a point; a line across the 180th meridian
    is cut there.

    Raises
    ------
    InvalidInput : the map has no georeference.
    """
    origin = origin_of(source, "geojson")
    sessions = {
        name: (poses, geodetic(origin, places(poses))) for name, poses in source.trajectories().items()
    }
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
    path = folder / "trajectory.geojson"
    path.write_text(json.dumps(collection, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    return [path]


def length_m(poses: Poses) -> float:
    """Length of the way driven, as the poses have it."""
    return float(np.linalg.norm(np.diff(places(poses), axis=0), axis=1).sum())


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
