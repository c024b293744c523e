"""PLY, binary little-endian: header and vertices of a cloud."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("class", "u1")]
)  # packed: 17 bytes a point
COLOURED = np.dtype([*VERTEX.descr, ("red", "u1"), ("green", "u1"), ("blue", "u1")])
_TYPES = {"<f4": "float", "<f8": "double", "<i4": "int", "|u1": "uchar"}


def header(points: int, comments: Sequence[str], vertex: np.dtype[Any] = VERTEX) -> bytes:
    """Header of a cloud of `points` vertices of packed fields; comments must be single lines."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}" for comment in comments]
    lines.append(f"element vertex {points}")
    lines += [f"property {_TYPES[vertex[name].str]} {name}" for name in vertex.names or ()]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace")


def vertices(
    points: NDArray[np.float32],
    intensity: NDArray[np.float32],
    class_: NDArray[np.uint8],
    colour: NDArray[np.uint8] | None = None,
) -> bytes:
    """Bytes of the vertices: points (n, 3), m; intensity (n,); class (n,); with colour (n, 3) they are `COLOURED`."""
    out = np.empty(len(points), VERTEX if colour is None else COLOURED)
    if colour is not None:
        out["red"], out["green"], out["blue"] = colour.T
    out["x"], out["y"], out["z"] = points[:, 0], points[:, 1], points[:, 2]
    out["intensity"], out["class"] = intensity, class_
    return out.tobytes()


def georeference_comments(
    frame: str, georeference: Mapping[str, Any] | None, offset_m: Sequence[float]
) -> list[str]:
    """Comments that place the cloud: frame, offset, CRS and origin of the map."""
    comments = [
        f"frame {frame}: local axes "
        + ("east, north, up" if georeference else "of the map, not georeferenced"),
        "offset_m {:.4f} {:.4f} {:.4f} (add to x y z to get the frame's coordinates)".format(*offset_m),
    ]
    if georeference:
        comments += [
            f"crs EPSG:{georeference['epsg']}",
            "origin_projected_m {easting_m:.4f} {northing_m:.4f}".format(**georeference),
            "origin_wgs84 {latitude_deg:.9f} {longitude_deg:.9f} {height_m:.4f}".format(**georeference),
            "grid_convergence_rad {grid_convergence_rad:.9f}".format(**georeference),
            "point_scale {point_scale:.9f}".format(**georeference),
        ]
    return comments


def without_colour(rows: bytes) -> bytes:
    """Vertices `COLOURED` as `VERTEX`."""
    coloured = np.frombuffer(rows, COLOURED)
    out = np.empty(len(coloured), VERTEX)
    for name in VERTEX.names or ():
        out[name] = coloured[name]
    return out.tobytes()
