"""Changed points as PLY."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.changes import Changes

VERTEX = np.dtype(
    [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("object", "<i4"), ("through", "<i4"), ("confirming", "<i4")]
)
_PLY = {"<f8": "double", "<i4": "int"}


def changes_ply(changes: Changes) -> bytes:
    """A cloud in the map's frame, doubles, with object and counts of every point."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment scanloom changes, frame {changes.frame}",
        f"element vertex {len(changes)}",
        *(f"property {_PLY[VERTEX[name].str]} {name}" for name in VERTEX.names or ()),
        "end_header",
    ]
    rows = np.empty(len(changes), VERTEX)
    columns = (changes.x_m, changes.y_m, changes.z_m, changes.object_, changes.through, changes.confirming)
    for name, values in zip(VERTEX.names or (), columns, strict=True):
        rows[name] = values
    return ("\n".join(lines) + "\n").encode() + rows.tobytes()
