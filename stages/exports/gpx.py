"""Trajectories as GPX 1.1: one track per session."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.antimeridian import wrapped
from scanloom.stages.exports.geojson import DEGREE_DECIMALS, METRE_DECIMALS, utc
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.se3 import F8

NAMESPACE = "http://www.topografix.com/GPX/1/1"
INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"


def write_gpx(source: MapSource, folder: Path, positions: dict[str, F8], heights: str) -> list[Path]:
    """`trajectory.gpx`, a point per scan with height and time.

    positions : longitude, latitude, height (n, 3) of each session's poses, degrees and m.
    heights : what they are counted from, in words; GPX itself leaves it open, and most programs take sea level.
    """
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
    _text(about, "desc", f"Positions of the LiDAR, WGS84. Elevations: {heights}.")
    for session, poses in source.trajectories().items():
        _track(root, session, poses, positions[session])
    ET.indent(root, " ")
    folder.mkdir(parents=True, exist_ok=True)
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
