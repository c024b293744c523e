"""3D Tiles 1.1: a tree of glTF point clouds that Cesium, QGIS, ArcGIS and others stream by level of detail.

Refinement is additive, every point is in one file. A georeferenced map stands on the Earth (ECEF) by the transform of its
root, which is exact, since the map's frame is Cartesian; another map keeps its own frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.frames import Georeference
from scanloom.stages.exports.node_points import NodeReader
from scanloom.stages.exports.nodes import Node
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import ecef_pose

MARGIN_M = 0.001
"""Boxes are so much larger than what they hold: coordinates are rounded to 32 bits."""

Json = dict[str, Any]


def write_3d_tiles(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """Write `tileset.json`, the tilesets of the tiles and all contents; returns their paths."""
    reader = NodeReader(source)
    written = [_write_json(folder / "tileset.json", map_tileset(reader, source.georeference))]
    for node in reader.root.walk():
        if node.points:
            written.append(_write_content(folder, reader, node))
        if node.door:
            tops = reader.within(node.name)
            written.append(_write_json(folder / path_of(node), tile_tileset(node, tops)))
            inside = (below for top in tops for below in top.walk() if below.points)
            written += [_write_content(folder, reader, below) for below in inside]
            source.passed()
    return written


def map_tileset(reader: NodeReader, georeference: Georeference | None) -> Json:
    """The tileset of a map down to its tiles; in its own frame without a georeference."""
    transform = None if georeference is None else ecef_pose(georeference).T.reshape(-1).tolist()
    return map_tileset_of(reader.root, transform)


def map_tileset_of(root: Node, transform: list[float] | None = None) -> Json:
    """The tileset of a tree of nodes."""
    body = tile_json(root, path_of)
    if transform is not None:
        body["transform"] = transform
    extent = float(np.linalg.norm(np.array(root.max_m) - np.array(root.min_m)))
    return _tileset(extent, body)


def tile_tileset(door: Node, tops: Sequence[Node]) -> Json:
    """The tileset within a tile; it lies beside the folder of the tile's contents."""
    inside = Node(**{**vars(door), "name": "", "door": False, "children": tuple(tops)})
    return _tileset(door.error_m, tile_json(inside, lambda node: f"{node.name}.glb"))


def path_of(node: Node) -> str:
    """File of a node in the folder of a tileset, and its path in what a viewer asks for."""
    if node.door:
        return f"tiles/{node.name}.json"
    if "/" in node.name:
        return f"tiles/{node.name}.glb"
    return "root.glb" if node.name == "root" else f"blocks/{node.name}.glb"


def tile_json(node: Node, uri: Callable[[Node], str]) -> Json:
    """A node and all below it as a tile of a tileset."""
    body: Json = {
        "boundingVolume": {"box": _box(node)},
        "geometricError": node.error_m,
        "refine": "ADD",
    }
    if node.points or node.door:
        body["content"] = {"uri": uri(node)}
    if node.children:
        body["children"] = [tile_json(child, uri) for child in node.children]
    return body


def _box(node: Node) -> list[float]:
    """Middle and half axes."""
    low, high = np.array(node.min_m) - MARGIN_M, np.array(node.max_m) + MARGIN_M
    x, y, z = ((high - low) / 2.0).tolist()
    return [*((low + high) / 2.0).tolist(), x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z]


def _tileset(error_m: float, root: Json) -> Json:
    return {"asset": {"version": "1.1"}, "geometricError": error_m, "root": root}


def _write_json(path: Path, body: Json) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(body, separators=(",", ":")))
    return path


def _write_content(folder: Path, reader: NodeReader, node: Node) -> Path:
    path = folder / path_of(node)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(reader.content(node))
    return path
