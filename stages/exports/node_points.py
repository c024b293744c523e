"""Points of nodes, read from a delivered map level by level; what was read lately stays in memory, within a bound."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.product import FOOTER_KEY
from scanloom.stages.exports.glb import VERTEX, glb
from scanloom.stages.exports.nodes import ROOT_POINTS, Levels, Node, door_level, tile_nodes, tree
from scanloom.stages.exports.source import MapSource, any_coloured

Columns = dict[str, NDArray[Any]]
COLUMNS = ("x_m", "y_m", "z_m", "intensity", "class_", "count", "first_ns", "last_ns", "session", "normal")
COLOUR = ("colour",)
"""Read where cameras saw the map; black stands for a point that none saw."""
CACHE_BYTES = 256 << 20
UNCLASSIFIED, STATIC, GROUND = 0, 2, 1
_TINTS = {GROUND: (0.93, 0.86, 0.74), STATIC: (0.80, 0.90, 1.0)}
"""Of the grey of the intensity, so that ground and what stands on it can be told apart."""


@dataclass(frozen=True)
class Points:
    """Points of a node; `tile` and `row` say where each stands."""

    xyz_m: NDArray[np.float64]
    """(n, 3) in the frame of the map."""
    columns: Columns
    """Each (n, ...), as in `Tile`; sessions numbered as in `NodeReader.sessions`."""

    def __len__(self) -> int:
        return len(self.xyz_m)


class Recent:
    """Values that were asked for lately, at most so many bytes of them."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._kept: OrderedDict[Any, tuple[Any, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Any, make: Callable[[], tuple[Any, int]]) -> Any:
        """The value of a key; `make` gives it and its size in bytes."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][0]
        value, size = make()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = (value, size)
                self._bytes += size
            while self._bytes > self._limit and len(self._kept) > 1:
                self._bytes -= self._kept.popitem(last=False)[1][1]
        return value

    @property
    def bytes(self) -> int:
        return self._bytes


class NodeReader:
    """Reads the nodes of a map. May be used by several threads."""

    def __init__(
        self, source: MapSource, cache_bytes: int = CACHE_BYTES, root_points: int = ROOT_POINTS
    ) -> None:
        self.source = source
        self.levels = Levels.of(source.index)
        self.root = tree(self.levels, root_points)
        self.sessions = sorted({name for names in source.index.sessions for name in str(names).split()})
        self._root_points = root_points
        self._number = {name: i for i, name in enumerate(self.levels.names)}
        self._recent = Recent(cache_bytes)
        self._overview = source.folder / "tiles" / "overview.parquet"
        self._overview_level = self._lowest_of_overview()
        self.coloured = self._has_colour()
        # Rows of the overview are ordered by tile within a level.
        self._before = np.cumsum(self.levels.points, axis=0) - self.levels.points

    def within(self, tile: str) -> tuple[Node, ...]:
        """The nodes behind the door of a tile.

        Raises
        ------
        KeyError : there is no such tile.
        """
        number = self._number[tile]
        levels = range(door_level(self.levels, self._root_points) + 1)

        def make() -> tuple[Any, int]:
            nodes = tile_nodes(
                self.levels, number, [self._local(number, level) for level in levels], self._root_points
            )
            return nodes, 2_000 * sum(1 for top in nodes for _ in top.walk())

        nodes: tuple[Node, ...] = self._recent.get(("nodes", number), make)
        return nodes

    def points(self, node: Node) -> Points:
        """All points of a node, coarsest level first."""
        parts = [
            self._part(level, tile, node)
            for level in range(node.coarsest, node.finest - 1, -1)
            for tile in self._groups(level, node)
        ]
        names = COLUMNS[3:] + COLOUR * self.coloured
        xyz = [self._offset_of(tiles) + _xyz(columns) for tiles, columns in parts]
        joined = {name: np.concatenate([columns[name] for _, columns in parts]) for name in names}
        return Points(np.concatenate(xyz), joined)

    def content(self, node: Node) -> bytes:
        """Points of a node as glTF."""
        points = self.points(node)
        low, high = points.xyz_m.min(axis=0), points.xyz_m.max(axis=0)
        x, y, z = ((low + high) / 2.0).tolist()
        return glb(vertices(points, np.array([x, y, z])), (x, y, z))

    # --- where points stand ---

    def _groups(self, level: int, node: Node) -> Iterator[tuple[int, ...]]:
        """Tiles of a node that are read together."""
        tiles = tuple(t for t in node.tiles if self.levels.points[t, level])
        if level >= self._overview_level:
            if tiles:
                yield tiles
        else:
            yield from ((tile,) for tile in tiles)

    def _part(self, level: int, tiles: tuple[int, ...], node: Node) -> tuple[NDArray[np.int64], Columns]:
        """Tile of each row, and the rows."""
        if node.last:
            rows = slice(node.first, node.last)
            columns = {name: a[rows] for name, a in self._of_tile(tiles[0], level).items()}
            return np.full(node.last - node.first, tiles[0]), columns
        if level < self._overview_level:
            columns = self._of_tile(tiles[0], level)
            return np.full(len(columns["x_m"]), tiles[0]), columns
        columns = self._of_overview(level)
        counts = self.levels.points[list(tiles), level]
        starts = self._before[list(tiles), level]
        rows_of = np.concatenate([np.arange(s, s + n) for s, n in zip(starts, counts)])
        return np.repeat(np.array(tiles), counts), {name: a[rows_of] for name, a in columns.items()}

    def _local(self, tile: int, level: int) -> NDArray[np.float64]:
        if not self.levels.points[tile, level]:
            return np.empty((0, 3))
        return _xyz(self._of_tile(tile, level))

    def _offset_of(self, tiles: NDArray[np.int64]) -> NDArray[np.float64]:
        place = self.levels.place[tiles] * self.levels.tile_size_m
        return np.column_stack((place, np.zeros(len(place))))

    # --- files ---

    def _of_tile(self, tile: int, level: int) -> Columns:
        """Rows of one level of a tile."""
        first = int(self.levels.first_row[tile, level])
        last = first + int(self.levels.points[tile, level])
        path = self.source.folder / "tiles" / f"{self.levels.names[tile]}.parquet"

        def make() -> tuple[Any, int]:
            columns = self._read(path, first, last)
            return columns, sum(a.nbytes for a in columns.values())

        columns: Columns = self._recent.get((tile, level), make)
        return columns

    def _of_overview(self, level: int) -> Columns:
        first = int(self.levels.points[:, level + 1 :].sum())
        last = first + int(self.levels.points[:, level].sum())

        def make() -> tuple[Any, int]:
            columns = self._read(self._overview, first, last)
            return columns, sum(a.nbytes for a in columns.values())

        columns: Columns = self._recent.get(("overview", level), make)
        return columns

    def _lowest_of_overview(self) -> int:
        """The finest level that the overview holds."""
        if not self._overview.exists():
            return self.levels.top + 1
        rows = pq.ParquetFile(self._overview).metadata.num_rows
        if not rows:
            return self.levels.top + 1
        down_to = np.cumsum(self.levels.points.sum(axis=0)[::-1])[::-1]
        fits = np.flatnonzero(down_to == rows)
        if not len(fits):
            raise InvalidInput(
                f"the overview has {rows} points, which are no levels of the index",
                where=str(self._overview),
                next_step="make the map again",
            )
        return int(fits[0])

    def _has_colour(self) -> bool:
        """Whether cameras saw any point of the map; the overview alone tells, where there is one."""
        return any_coloured(self._overview) if self._overview.exists() else self.source.coloured

    def _read(self, path: Path, first: int, last: int) -> Columns:
        """Rows of a file, from the row groups that hold them."""
        try:
            file = pq.ParquetFile(path, page_checksum_verification=True)
            ends = np.cumsum([file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)])
            begins = np.concatenate(([0], ends[:-1]))
            groups = np.flatnonzero((ends > first) & (begins < last))
            known = [name for name in COLUMNS + COLOUR * self.coloured if name in file.schema_arrow.names]
            table = file.read_row_groups(groups.tolist(), columns=known, use_threads=False)
        except (OSError, ValueError) as error:
            raise InvalidInput(
                f"cannot be read: {error}", where=str(path), next_step="make the map again"
            ) from error
        table = table.slice(first - int(begins[groups[0]]), last - first)
        columns = {name: _numpy(table.column(name)) for name in known}
        columns["session"] = self._renumbered(file, columns["session"])
        return columns

    def _renumbered(self, file: pq.ParquetFile, session: NDArray[Any]) -> NDArray[np.uint16]:
        """Sessions as numbers in `self.sessions` instead of the file's own list."""
        import json

        footer = json.loads((file.metadata.metadata or {})[FOOTER_KEY])
        names = footer["attributes"]["sessions"]
        numbers = np.array([self.sessions.index(name) for name in names] or [0], np.uint16)
        return np.asarray(numbers[session], np.uint16)


def vertices(points: Points, centre_m: NDArray[np.float64]) -> NDArray[Any]:
    """Vertices (n,) of dtype `glb.VERTEX`."""
    out = np.zeros(len(points), VERTEX)
    out["position"] = points.xyz_m - centre_m
    out["colour"] = _colours(points.columns["intensity"], points.columns["class_"])
    if COLOUR[0] in points.columns:
        seen = points.columns[COLOUR[0]]
        coloured = seen.any(axis=1)
        out["colour"][coloured, :3] = seen[coloured]
    out["intensity"] = points.columns["intensity"]
    out["class"][:, 0] = points.columns["class_"]
    out["normal"][:, :3] = points.columns["normal"]
    out["session"][:, 0] = points.columns["session"]
    return out


def _colours(intensity: NDArray[Any], class_: NDArray[Any]) -> NDArray[np.uint8]:
    """(n, 4): brightness by intensity, which sensors give on scales from 0 to 1 up to 0 to 255, tint by class."""
    scale = 1.0 if len(intensity) == 0 or np.nanmax(intensity) <= 1.0 else 255.0
    grey = 60.0 + 195.0 * np.sqrt(np.clip(np.nan_to_num(intensity) / scale, 0.0, 1.0))
    tints = np.ones((256, 3))
    for number, tint in _TINTS.items():
        tints[number] = tint
    rgb = grey[:, None] * tints[class_]
    return np.column_stack((rgb, np.full(len(rgb), 255.0))).astype(np.uint8)


def _xyz(columns: Columns) -> NDArray[np.float64]:
    return np.column_stack([columns[name] for name in COLUMNS[:3]]).astype(np.float64)


def _numpy(column: Any) -> NDArray[Any]:
    array = column.combine_chunks()
    if hasattr(array, "chunks"):
        import pyarrow as pa

        array = pa.concat_arrays(array.chunks)
    if str(array.type).startswith("fixed_size_binary"):
        width = array.type.byte_width  # several bytes to a row
        flat = np.frombuffer(array.buffers()[1], np.uint8, len(array) * width, array.offset * width)
        return np.asarray(flat.reshape(len(array), width))
    if hasattr(array.type, "list_size"):
        flat = array.flatten().to_numpy(zero_copy_only=False)
        return np.asarray(flat.reshape(len(array), -1))
    return np.asarray(array.to_numpy(zero_copy_only=False))
