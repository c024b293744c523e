"""Trajectories as GPX 1.1: one track per session."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.antimeridian import wrapped
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.wgs84 import (
    DEGREE_DECIMALS,
    METRE_DECIMALS,
    geodetic,
    origin_of,
    places,
    utc,
)
from scanloom.stages.geometry.se3 import F8

NAMESPACE = "http://www.topografix.com/GPX/1/1"
INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"


def write_gpx(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`trajectory.gpx`, a point per scan with height and time.

    GPX leaves open what elevations are counted from, and most programs take sea level; the file's description says it.

    Raises
    ------
    InvalidInput : the map has no georeference.
    UsageError : the grid for orthometric heights is not installed.
    """
    origin = origin_of(source, "gpx")
    projector = Projector.of(source, options)
    root = ET.Element(
        "gpx",
        {
            "version": "1.1",
            "creator": "Scanloom",
            "xmlns": NAMESPACE,
            "xmlns:xsi": INSTANCE,
            "xsi:schemaLocation": f"{NAMESPACE} {NAMESPACE}/gpx.xsd",
        },
    )
    about = ET.SubElement(root, "metadata")
    _text(about, "name", source.name)
    _text(about, "desc", f"Positions of the LiDAR, WGS84. Elevations: {projector.heights}.")
    for session, poses in source.trajectories().items():
        positions = geodetic(origin, places(poses))
        positions[:, 2] = projector.project(places(poses))[:, 2]
        _track(root, session, poses, positions)
    ET.indent(root, " ")
    path = folder / "trajectory.gpx"
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return [path]


def _track(root: ET.Element, session: str, poses: Poses, positions: F8) -> None:
    track = ET.SubElement(root, "trk")
    _text(track, "name", session)
    segment = ET.SubElement(track, "trkseg")
    # 180 degrees itself is outside the format's range and means the same as -180.
    longitudes = wrapped(np.round(positions[:, 0], DEGREE_DECIMALS))
    for stamp, longitude, (latitude, height) in zip(
        poses.stamp_ns, longitudes, positions[:, 1:], strict=True
    ):
        at = {"lat": f"{latitude:.{DEGREE_DECIMALS}f}", "lon": f"{longitude:.{DEGREE_DECIMALS}f}"}
        point = ET.SubElement(segment, "trkpt", at)
        _text(point, "ele", f"{height:.{METRE_DECIMALS}f}")
        _text(point, "time", utc(stamp))


def _text(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, tag).text = text
