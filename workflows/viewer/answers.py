"""What the page asks for, answered from the folder of a map: tilesets, contents, what a point is."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.exports.node_points import COLOUR, NodeReader, Points
from scanloom.stages.exports.nodes import ROOT_POINTS, Node
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.tiles3d import map_tileset, tile_tileset
from scanloom.stages.geometry.geodesy import world_to_geodetic, world_to_projected
from scanloom.workflows.viewer.layers import Layers
from scanloom.workflows.viewer.removed import Removed

Json = dict[str, Any]
SPREAD_PERCENT = (1.0, 99.0)
"""Colours span heights and intensities between these percentiles."""

MOST_PERCENT = (0.5, 99.5)
"""The first view shows what lies between these percentiles along each axis: a few stray points do not make the map small."""


class Missing(Exception):
    """There is nothing of that name."""


class Answers:
    """Read-only view of one map. May be asked by several threads."""

    def __init__(self, folder: Path, root_points: int = ROOT_POINTS) -> None:
        self.source = MapSource.open(folder)
        self.reader = NodeReader(self.source, root_points=root_points)
        self.layers = Layers(self.source)
        self.removed = Removed(self.source)
        self._blocks = {node.name: node for node in self.reader.root.walk()}

    def prepare(self) -> None:
        """Read what the page asks for first, before it does."""
        self.answer("map.json")

    def answer(self, path: str) -> tuple[str, bytes]:
        """Content type and body of what stands at a path below `/data/`.

        Raises
        ------
        Missing : nothing stands there.
        """
        head, _, rest = path.partition("/")
        kinds: dict[str, Callable[[str], tuple[str, bytes]]] = {
            "map.json": self._summary,
            "layers.json": self._layers,
            "tileset": self._tileset,
            "removed": self._removed,
            "point": self._point,
        }
        if head not in kinds:
            raise Missing(path)
        try:
            return kinds[head](rest)
        except (KeyError, ValueError, IndexError) as error:
            raise Missing(path) from error

    # --- tilesets ---

    def node(self, name: str) -> Node:
        """A node by its name.

        Raises
        ------
        KeyError : there is none.
        """
        tile, slash, _ = name.partition("/")
        if not slash:
            return self._blocks[name]
        for top in self.reader.within(tile):
            for node in top.walk():
                if node.name == name:
                    return node
        raise KeyError(name)

    def _tileset(self, path: str) -> tuple[str, bytes]:
        if path == "tileset.json":
            return _json(map_tileset(self.reader, None))
        if path.startswith("tiles/") and path.endswith(".json"):
            door = self.node(path.removeprefix("tiles/").removesuffix(".json"))
            return _json(tile_tileset(door, self.reader.within(door.name)))
        if not path.endswith(".glb"):
            raise KeyError(path)
        node = self.node(path.removesuffix(".glb").removeprefix("blocks/").removeprefix("tiles/"))
        if not node.points:
            raise KeyError(path)
        return "model/gltf-binary", self.reader.content(node)

    # --- words and numbers ---

    def _summary(self, _: str) -> tuple[str, bytes]:
        source, root = self.source, self.reader.root
        sample = self.reader.points(root)
        georeference = source.georeference
        return _json(
            {
                "name": source.name,
                "version": source.header.get("version", 1),
                "points": source.points,
                "tiles": len(source.tile_names),
                "crs": crs_name(georeference.epsg) if georeference else None,
                "epsg": georeference.epsg if georeference else None,
                "min_m": root.min_m,
                "max_m": root.max_m,
                "most_m": np.percentile(sample.xyz_m, MOST_PERCENT, axis=0).tolist(),
                "voxel_size_m": source.index.voxel_size_m,
                "sessions": self.reader.sessions,
                "height_m": _spread(sample.xyz_m[:, 2]),
                "intensity": _spread(sample.columns["intensity"]),
                "classes": {int(c): PointClass(c).name.lower() for c in np.unique(sample.columns["class_"])},
                "removed": self.removed.summary(),
                "coloured": self.reader.coloured,
            }
        )

    def _layers(self, _: str) -> tuple[str, bytes]:
        return _json(self.layers.everything())

    def _removed(self, path: str) -> tuple[str, bytes]:
        """Its tileset and contents, and `point/NODE/ROW`: one point, why it was left out, and where."""
        if not path.startswith("point/"):
            return self.removed.answer(path)
        name, _, row = path.removeprefix("point/").rpartition("/")
        about = self.removed.point(name.removeprefix("blocks/"), int(row))
        return _json(about | self._place(np.array(about["map_m"])))

    def _point(self, path: str) -> tuple[str, bytes]:
        """`NODE/ROW`: everything that is known of one point."""
        name, _, row = path.rpartition("/")
        node = self.node(name.removeprefix("blocks/").removeprefix("tiles/"))
        if not 0 <= int(row) < node.points:
            raise IndexError(row)
        return _json(self._about(self.reader.points(node), int(row)))

    def _about(self, points: Points, row: int) -> Json:
        xyz = points.xyz_m[row]
        value = {name: column[row] for name, column in points.columns.items()}
        about: Json = {
            "map_m": xyz.tolist(),
            "class": PointClass(int(value["class_"])).name.lower(),
            "intensity": float(value["intensity"]),
            "count": int(value["count"]),
            "session": self.reader.sessions[int(value["session"])] if self.reader.sessions else "",
            "first_ns": str(value["first_ns"]),
            "last_ns": str(value["last_ns"]),
            "normal": (value["normal"] / 127.0).tolist() if value["normal"].any() else None,
        }
        if self.reader.coloured:
            about["colour"] = value[COLOUR[0]].tolist()
        return about | self._place(xyz)

    def _place(self, xyz: NDArray[np.float64]) -> Json:
        """Where a point (3,) of the map's frame is on the Earth; nothing without a georeference."""
        georeference = self.source.georeference
        if georeference is None:
            return {}
        easting, northing, height = world_to_projected(georeference, xyz)[0].tolist()
        latitude, longitude, _ = world_to_geodetic(georeference, xyz)[0].tolist()
        return {
            "epsg": georeference.epsg, "easting_m": easting, "northing_m": northing, "height_m": height,
            "latitude_deg": latitude, "longitude_deg": longitude,
        }  # fmt: skip


def crs_name(epsg: int) -> str:
    """Name of a reference system, for instance `WGS 84 / UTM zone 32N`."""
    from pyproj import CRS

    return str(CRS.from_epsg(epsg).name)


def _spread(values: Any) -> list[float]:
    low, high = np.nanpercentile(values, SPREAD_PERCENT).tolist()
    return [low, high if high > low else low + 1.0]


def _json(body: Any) -> tuple[str, bytes]:
    return "application/json", json.dumps(body, separators=(",", ":")).encode()
