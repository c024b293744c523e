"""3D Tiles as py3dtiles reads them: number of files and points, and their bounds, as JSON on standard output.

`PYTHON benchmarks/py3dtiles_reader.py FOLDER` with the Python of an environment of its own: py3dtiles forces an older numpy and numba.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from py3dtiles.tileset import TileSet


def main() -> None:
    tileset = TileSet.from_file(Path(sys.argv[1]) / "tileset.json")
    stack = [(tileset.root_tile, tileset.root_uri)]
    files, points, low, high = 0, 0, np.full(3, np.inf), np.full(3, -np.inf)
    while stack:
        tile, root = stack.pop()
        stack += [(child, root) for child in tile.children]
        content = tile.get_or_fetch_content(root) if tile.has_content() else None
        if isinstance(content, TileSet):
            stack.append((content.root_tile, content.root_uri))
        elif content is not None:
            count, corners = _cloud(content._gltf)
            files, points = files + 1, points + count
            low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
    print(json.dumps({"files": files, "points": points, "low": low.tolist(), "high": high.tolist()}))


def _cloud(gltf) -> tuple[int, np.ndarray]:
    """Points of a content, and two corners (2, 3) of it in the frame of the tileset, where z is up."""
    position = gltf.accessors[gltf.meshes[0].primitives[0].attributes.POSITION]
    placed = np.reshape(gltf.nodes[0].matrix, (4, 4)).T
    x, y, z = (placed @ np.column_stack((np.array([position.min, position.max]), [1, 1])).T)[:3]
    return position.count, np.column_stack((x, -z, y))


if __name__ == "__main__":
    main()
