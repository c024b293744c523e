"""PCD: the format of the Point Cloud Library, x y z intensity and class, binary."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.exports.clouds import Cloud, clouds, points_of, round_offset_m
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.sidecar import placement_comments, write_placement
from scanloom.stages.exports.source import MapSource

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("class", "u1")])
COLOURED = np.dtype([*POINT.descr, ("rgb", "<u4")])
"""Where cameras saw the map: red, green, blue in one number, as the Point Cloud Library packs them; 0 where none saw a point."""
_KINDS = {"f": "F", "u": "U", "i": "I"}


def write_pcd(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`map.pcd` and, beside it, `map.json` with offset and coordinate system, which PCD has no place for."""
    projector = Projector.of(source, options)
    offset_m = round_offset_m(source, projector)
    path = folder / "map.pcd"
    point = COLOURED if source.coloured else POINT
    with path.open("wb") as stream:
        comments = [f"scanloom map {source.name}", *placement_comments(projector, offset_m)]
        stream.write(header(points_of(source, options), comments, point))
        for cloud in clouds(source, projector, options):
            stream.write(rows(cloud, offset_m, point).data)
    return [path, write_placement(folder / "map.json", projector, offset_m)]


def header(points: int, comments: Sequence[str], point: np.dtype[Any] = POINT) -> bytes:
    """Header of version 0.7 for so many packed rows of `point`; comments must be single lines."""
    kinds = [point[name] for name in point.names or ()]
    lines = [f"# {comment}" for comment in comments] + [
        "VERSION 0.7",
        f"FIELDS {' '.join(point.names or ())}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(_KINDS[kind.kind] for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {points}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii", "replace")


def rows(cloud: Cloud, offset_m: NDArray[np.float64], point: np.dtype[Any] = POINT) -> NDArray[np.void]:
    """Packed rows (n,) of `point`, which is `POINT` or `COLOURED`."""
    out = np.empty(len(cloud), point)
    if point == COLOURED:
        red, green, blue = cloud.tile.colour.T.astype(np.uint32)
        out["rgb"] = (red << 16) | (green << 8) | blue
    for axis, name in enumerate("xyz"):
        out[name] = cloud.xyz[:, axis] - offset_m[axis]
    out["intensity"], out["class"] = cloud.tile.intensity, cloud.tile.class_
    return out
