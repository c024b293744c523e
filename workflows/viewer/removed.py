"""Points that were left out of the map, streamed from `removed.ply`: first one in so many of all, then tile by tile."""

from __future__ import annotations

import json
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import RemovedTile
from scanloom.stages.exports.glb import VERTEX, glb
from scanloom.stages.exports.nodes import Node
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.tiles3d import map_tileset_of
from scanloom.stages.geometry import ply

ROOT_POINTS = 50_000
MOST_PER_TILE = 200_000
"""Points of one tile that are shown; of more every n-th is."""


NEAR_M = 0.02
"""A removed point of the picture is the one of its tile that lies this near: coordinates of the file have 32 bits."""
WHY = {
    PointClass.DYNAMIC: "it moved while it was seen: a tracked vehicle or person, or what rays saw through at other times",
    PointClass.AIRBORNE: "it hung in the air: dust, rain or snow",
    PointClass.OUTLIER: "it is a stray: nothing measured near it, in its scan or its neighbours, bears it out",
    PointClass.CHANGED: "it stood while one session passed and was gone when a later one saw through its place",
}


class Removed:
    """The file is mapped into memory, not read; places of tiles in it are found when somebody asks first."""

    def __init__(self, source: MapSource) -> None:
        self._tiles = source.folder / "removed"
        self._path = source.folder / "removed.ply"
        self._tile_m = source.index.tile_size_m

    def summary(self) -> dict[str, Any]:
        return {
            "points": len(self._points),
            "classes": {int(c): PointClass(c).name.lower() for c in np.unique(self._points["class"])},
        }

    def answer(self, path: str) -> tuple[str, bytes]:
        """`tileset.json`, `root.glb` or `blocks/N.glb`."""
        if path == "tileset.json":
            return "application/json", json.dumps(map_tileset_of(self._root)).encode()
        nodes = {node.name: node for node in self._root.walk()}
        node = nodes[path.removesuffix(".glb").removeprefix("blocks/")]
        points = self._points[self._rows(node)]
        xyz = np.column_stack((points["x"], points["y"], points["z"])).astype(np.float64)
        centre = (xyz.min(axis=0) + xyz.max(axis=0)) / 2.0
        vertices = np.zeros(len(points), VERTEX)
        vertices["position"] = xyz - centre
        vertices["intensity"] = points["intensity"]
        vertices["class"][:, 0] = points["class"]
        x, y, z = centre.tolist()
        return "model/gltf-binary", glb(vertices, (x, y, z))

    def point(self, name: str, row: int) -> dict[str, Any]:
        """What is known of a point of a node: place in the map's frame, class, why it was left out, when it was seen.

        Raises
        ------
        KeyError, IndexError : there is no such node or row.
        """
        rows = self._rows({node.name: node for node in self._root.walk()}[name])
        if not 0 <= row < len(rows):
            raise IndexError(row)
        point = self._points[int(rows[row])]
        xyz = [float(point[axis]) for axis in "xyz"]
        class_ = PointClass(int(point["class"]))
        about = {
            "map_m": xyz,
            "class": class_.name.lower(),
            "intensity": float(point["intensity"]),
            "why": WHY.get(class_, ""),
        }
        return about | self._seen(np.array(xyz), class_)

    def _seen(self, xyz: NDArray[np.float64], class_: PointClass) -> dict[str, Any]:
        """Session, count and stamps, from the tile of removed points; nothing when it is not there."""
        x, y = np.floor(xyz[:2] / self._tile_m).astype(int)
        path = self._tiles / f"{x}_{y}.parquet"
        if not path.exists():
            return {}
        tile = RemovedTile.open(path)
        places = np.column_stack((tile.x_m, tile.y_m, tile.z_m)) + np.array(tile.offset_m)
        off = np.where(tile.class_ == class_, np.abs(places - xyz).max(axis=1), np.inf)
        nearest = int(np.argmin(off)) if len(off) else -1
        if nearest < 0 or off[nearest] > NEAR_M:
            return {}
        return {
            "count": int(tile.count[nearest]),
            "session": tile.sessions[int(tile.session[nearest])],
            "first_ns": str(tile.first_ns[nearest]),
            "last_ns": str(tile.last_ns[nearest]),
        }

    @cached_property
    def _points(self) -> NDArray[Any]:
        if not self._path.exists():
            return np.empty(0, ply.VERTEX)
        with self._path.open("rb") as stream:
            count = 0
            for line in stream:
                words = line.split()
                if words[:2] == [b"element", b"vertex"]:
                    count = int(words[2])
                if words == [b"end_header"]:
                    break
            start = stream.tell()
        if not count:
            return np.empty(0, ply.VERTEX)
        return np.memmap(self._path, ply.VERTEX, "r", start, (count,))

    @cached_property
    def _root(self) -> Node:
        """A root with every n-th point, below it the rest of each tile; points of a tile follow each other."""
        points = self._points
        tile = np.floor(np.column_stack((points["x"], points["y"])) / self._tile_m)
        firsts: Any = (
            np.flatnonzero(np.append(True, (tile[1:] != tile[:-1]).any(axis=1))) if len(points) else []
        )
        children = [
            self._node(str(first), int(first), int(last))
            for first, last in zip(firsts, [*firsts[1:], len(points)])
        ]
        everywhere = self._node("root", 0, len(points))
        below = tuple(child for child in children if child.points)
        return Node(**{**vars(everywhere), "children": below, "error_m": 1.0})

    @property
    def _step(self) -> int:
        return max(1, -(-len(self._points) // ROOT_POINTS))

    def _rows(self, node: Node) -> NDArray[np.int64]:
        rows: NDArray[np.int64] = np.arange(node.first, node.last)
        of_root = rows % self._step == 0
        if node.name == "root":
            return np.asarray(rows[of_root])
        rest = np.asarray(rows[~of_root])
        return rest[:: max(1, -(-len(rest) // MOST_PER_TILE))]

    def _node(self, name: str, first: int, last: int) -> Node:
        points = self._points[first:last]
        corners = [
            [float(f(points[axis])) if len(points) else 0.0 for axis in "xyz"] for f in (np.min, np.max)
        ]
        node = Node(
            name=name, finest=0, coarsest=0, points=0, error_m=0.0, min_m=tuple(corners[0]), max_m=tuple(corners[1]),
            tiles=(), first=first, last=last,
        )  # fmt: skip
        return Node(**{**vars(node), "points": len(self._rows(node))})
