"""PLY: every point and every column of the map in one cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.exports.clouds import Cloud, clouds, points_of, round_offset_m, session_names
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.sidecar import placement_comments, write_placement
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry import ply

VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("nx", "<f4"),
        ("ny", "<f4"),
        ("nz", "<f4"),
        ("intensity", "<f4"),
        ("class", "u1"),
        ("level", "u1"),
        ("session", "<i4"),
        ("count", "<i4"),
        ("first_s", "<f8"),
        ("last_s", "<f8"),
    ]
)
COLOURED = np.dtype([*VERTEX.descr, ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("views", "<i4")])
"""Where cameras saw the map; black and 0 where none saw a point."""
_S_PER_NS = 1e-9


def write_ply(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`map.ply` and, beside it, `map.json` with offset and coordinate system.

    Coordinates are float32 from a round offset: whole UTM coordinates in float32 would have steps of half a metre, and
    few programs read doubles without rounding them to float32 themselves.
    """
    projector = Projector.of(source, options)
    offset_m = round_offset_m(source, projector)
    path = folder / "map.ply"
    comments = [
        f"scanloom map {source.name}",
        *placement_comments(projector, offset_m),
        "class 1 ground, 2 static; first_s last_s: seconds of the log's clock, mostly since 1970",
        *(f"session {number} {name}" for number, name in enumerate(session_names(source))),
    ]
    vertex = COLOURED if source.coloured else VERTEX
    with path.open("wb") as stream:
        stream.write(ply.header(points_of(source, options), comments, vertex))
        for cloud in clouds(source, projector, options):
            stream.write(vertices(cloud, offset_m, vertex).data)
    return [path, write_placement(folder / "map.json", projector, offset_m)]


def vertices(cloud: Cloud, offset_m: NDArray[np.float64], vertex: np.dtype[Any]) -> NDArray[np.void]:
    """Packed rows (n,) of `vertex`, which is `VERTEX` or `COLOURED`."""
    tile, normals = cloud.tile, cloud.normals
    out = np.empty(len(cloud), vertex)
    if vertex == COLOURED:
        out["red"], out["green"], out["blue"] = tile.colour.T
        out["views"] = tile.views
    for axis, name in enumerate("xyz"):
        out[name] = cloud.xyz[:, axis] - offset_m[axis]
        out[f"n{name}"] = normals[:, axis]
    out["intensity"], out["class"], out["count"] = tile.intensity, tile.class_, tile.count
    out["level"], out["session"] = tile.level, tile.session
    out["first_s"], out["last_s"] = tile.first_ns * _S_PER_NS, tile.last_ns * _S_PER_NS
    return out
