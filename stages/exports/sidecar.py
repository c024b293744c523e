"""What a format with no place for a coordinate system is accompanied by."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.exports.coordinates import Projector


def placement(projector: Projector, offset_m: NDArray[np.float64]) -> dict[str, Any]:
    """How to get from the numbers in a file to a place on the Earth."""
    return {
        "offset_m": offset_m.tolist(),
        "meaning": "add offset_m to x, y, z of the file",
        "epsg": projector.epsg,
        "vertical_epsg": projector.vertical_epsg,
        "heights": projector.heights,
        "crs_wkt": projector.crs.to_wkt() if projector.epsg else None,
    }


def placement_comments(projector: Projector, offset_m: NDArray[np.float64]) -> list[str]:
    """The same in single lines for a header."""
    x, y, z = offset_m
    lines = [f"offset_m {x:.3f} {y:.3f} {z:.3f} (add to x y z)"]
    if projector.epsg is None:
        lines.append("crs none: the map has no georeference, coordinates are its own")
    else:
        code = f"EPSG:{projector.epsg}" + (f"+{projector.vertical_epsg}" if projector.vertical_epsg else "")
        lines.append(f"crs {code}, x east, y north")
    return [*lines, f"heights {projector.heights}"]


def write_placement(path: Path, projector: Projector, offset_m: NDArray[np.float64]) -> Path:
    """Write `placement` as JSON."""
    path.write_text(json.dumps(placement(projector, offset_m), indent=1) + "\n")
    return path
