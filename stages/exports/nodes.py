"""The tree of nodes in which a map is streamed: every point is in exactly one node, coarse ones first.

The root holds the coarsest levels of the whole map. A node of level k below covers a square of 128 x 128 cells of that level
over all heights, until that is one tile; within a tile it covers a cube of 128 x 128 x 128 cells. A node adds its points to
those of the nodes above (additive refinement), together they are the map thinned to the node's `error_m`.

The tree down to the tiles follows from the index of the map alone. A tile's own nodes need its points, so they hang below a
*door*, a node without points that is opened when somebody comes near.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import ProductError
from scanloom.schemas.tiles import TileIndex, levels_of, spacing_m

F8 = NDArray[np.float64]
I8 = NDArray[np.int64]

CELL_BITS = 7
"""A node is 2^7 = 128 cells of its level wide."""
PLACE_BITS = 10
"""Rows of a tile are ordered by places in steps of tile / 2^10."""
ROOT_POINTS = 50_000
"""The root takes whole levels as long as it stays below."""


@dataclass(frozen=True)
class Node:
    """Points of the levels `finest` to `coarsest`: of whole tiles (a block), or of the rows `first` to `last` of one tile."""

    name: str
    """`root`, `LEVEL_X_Y` of a block, `TILE` of a door, `TILE/LEVEL_X_Y_Z` within a tile."""
    finest: int
    coarsest: int
    points: int
    error_m: float
    """Spacing of the points down to here; 0 where nothing finer follows."""
    min_m: tuple[float, ...]
    """Of the points here and below, in the frame of the map."""
    max_m: tuple[float, ...]
    tiles: tuple[int, ...]
    """Numbers of the tiles in the order of the index."""
    first: int = 0
    last: int = 0
    door: bool = False
    children: tuple[Node, ...] = ()

    def walk(self) -> Iterator[Node]:
        """This node and all below, doors closed."""
        yield self
        for child in self.children:
            yield from child.walk()


@dataclass(frozen=True)
class Levels:
    """The index as arrays: tile by level."""

    names: tuple[str, ...]
    place: I8
    """(tiles, 2) in steps of the tile size."""
    points: I8
    """(tiles, levels), level 0 first."""
    first_row: I8
    low_m: F8
    """(tiles, levels, 3) of this level and all finer ones; infinite where there are none."""
    high_m: F8
    tile_size_m: float
    voxel_size_m: float

    @classmethod
    def of(cls, index: TileIndex) -> Levels:
        names = tuple(index.names)
        number = {name: i for i, name in enumerate(names)}
        tile = np.array([number[str(name)] for name in index.tile], np.int64)
        top = levels_of(index.tile_size_m, index.voxel_size_m)
        count = max(top, int(index.level.max(initial=0))) + 1
        points, first_row = np.zeros((len(names), count), np.int64), np.zeros((len(names), count), np.int64)
        low, high = np.full((len(names), count, 3), np.inf), np.full((len(names), count, 3), -np.inf)
        points[tile, index.level], first_row[tile, index.level] = index.points, index.first_row
        filled = index.points > 0
        low[tile[filled], index.level[filled]] = index.min_m[filled]
        high[tile[filled], index.level[filled]] = index.max_m[filled]
        return cls(
            names=names,
            place=np.array([name.split("_") for name in names], np.int64).reshape(-1, 2),
            points=points,
            first_row=first_row,
            low_m=np.minimum.accumulate(low, axis=1),
            high_m=np.maximum.accumulate(high, axis=1),
            tile_size_m=index.tile_size_m,
            voxel_size_m=index.voxel_size_m,
        )

    @property
    def top(self) -> int:
        return int(self.points.shape[1]) - 1

    @property
    def of_tile(self) -> int:
        """The level whose nodes are as wide as a tile; negative where even those of level 0 are wider."""
        return levels_of(self.tile_size_m, self.voxel_size_m) - CELL_BITS

    def error_m(self, level: int) -> float:
        return spacing_m(level, self.tile_size_m, self.voxel_size_m) if level else 0.0

    def root_level(self, root_points: int) -> int:
        """Finest level of the root."""
        below = np.cumsum(self.points.sum(axis=0)[::-1])[::-1] <= root_points
        return int(np.argmax(below)) if below.any() else self.top


def tree(levels: Levels, root_points: int = ROOT_POINTS) -> Node:
    """The tree of a map down to its tiles."""
    finest = levels.root_level(root_points)
    everything = np.arange(len(levels.names))
    children = tuple(_below(levels, everything, finest - 1))
    return _block(levels, "root", everything, finest, levels.top, children)


def _below(levels: Levels, tiles: I8, level: int) -> Iterator[Node]:
    """Nodes of a level that cover these tiles, with all below them."""
    if level < 0:
        return
    shift = level - levels.of_tile
    if shift < 0:
        yield from (
            _door(levels, int(tile), level) for tile in tiles if np.isfinite(levels.low_m[tile, level, 0])
        )
        return
    tiles = tiles[np.isfinite(levels.low_m[tiles, level, 0])]
    squares, member = np.unique(levels.place[tiles] >> shift, axis=0, return_inverse=True)
    for number, (x, y) in enumerate(squares):
        here = tiles[member.reshape(-1) == number]
        name = f"{level}_{x}_{y}"
        yield _block(levels, name, here, level, level, tuple(_below(levels, here, level - 1)))


def _block(
    levels: Levels, name: str, tiles: I8, finest: int, coarsest: int, children: tuple[Node, ...]
) -> Node:
    return Node(
        name=name,
        finest=finest,
        coarsest=coarsest,
        points=int(levels.points[tiles, finest : coarsest + 1].sum()),
        error_m=levels.error_m(finest) if children else 0.0,
        min_m=tuple(levels.low_m[tiles, coarsest].min(axis=0, initial=np.inf).tolist()),
        max_m=tuple(levels.high_m[tiles, coarsest].max(axis=0, initial=-np.inf).tolist()),
        tiles=tuple(tiles.tolist()),
        children=children,
    )


def _door(levels: Levels, tile: int, level: int) -> Node:
    """What stands for the nodes within a tile, of a level and below, until they are asked for."""
    return Node(
        name=levels.names[tile],
        finest=0,
        coarsest=level,
        points=0,
        error_m=levels.error_m(level + 1),
        min_m=tuple(levels.low_m[tile, level].tolist()),
        max_m=tuple(levels.high_m[tile, level].tolist()),
        tiles=(tile,),
        door=True,
    )


def door_level(levels: Levels, root_points: int = ROOT_POINTS) -> int:
    """The coarsest level within the tiles; -1 where all levels are in blocks."""
    return min(max(levels.of_tile, 0), levels.root_level(root_points)) - 1


def tile_nodes(
    levels: Levels, tile: int, xyz_m: list[F8], root_points: int = ROOT_POINTS
) -> tuple[Node, ...]:
    """Nodes within a tile.

    xyz_m : for each level within the tile, 0 first, its points (n, 3) from the tile's origin in the order of their rows.

    Raises
    ------
    ProductError : rows are not in the order of places.
    """
    offset = np.append(levels.place[tile] * levels.tile_size_m, 0.0)
    found: dict[tuple[int, ...], Node] = {}
    for level, points in enumerate(xyz_m[: door_level(levels, root_points) + 1]):
        cubes, firsts = _runs(points, levels, level)
        if len(set(cubes)) < len(cubes):
            raise ProductError(
                f"rows of level {level} are not in order",
                where=f"tile {levels.names[tile]}",
                next_step="make the map again",
            )
        runs = dict(zip(cubes, zip(firsts, [*firsts[1:], len(points)])))
        found = _level_nodes(levels, tile, level, points + offset, runs, found)
    return tuple(found[cube] for cube in sorted(found))


def _runs(points: F8, levels: Levels, level: int) -> tuple[list[tuple[int, ...]], list[int]]:
    """Cube of each run of rows, and the first of them."""
    if not len(points):
        return [], []
    shift = PLACE_BITS - (levels.of_tile - level)
    steps = np.floor(points * 2.0**PLACE_BITS / levels.tile_size_m).astype(np.int64)
    steps[:, :2] = np.clip(steps[:, :2], 0, 2**PLACE_BITS - 1)
    cube = steps >> shift
    firsts = np.flatnonzero(np.append(True, (cube[1:] != cube[:-1]).any(axis=1)))
    return [tuple(c) for c in cube[firsts].tolist()], firsts.tolist()


def _level_nodes(
    levels: Levels,
    tile: int,
    level: int,
    points: F8,
    runs: dict[tuple[int, ...], tuple[int, int]],
    finer: dict[tuple[int, ...], Node],
) -> dict[tuple[int, ...], Node]:
    """Nodes of one level within a tile by their cubes, above those of the next finer one."""
    children: dict[tuple[int, ...], list[Node]] = {}
    for cube in sorted(finer):
        children.setdefault(tuple(c >> 1 for c in cube), []).append(finer[cube])
    nodes = {}
    for cube in sorted(runs.keys() | children.keys()):
        first, last = runs.get(cube, (0, 0))
        below = children.get(cube, [])
        corners = [points[first:last], *(np.array([node.min_m, node.max_m]) for node in below)]
        extent = np.concatenate(corners)
        nodes[cube] = Node(
            name=f"{levels.names[tile]}/{level}_{cube[0]}_{cube[1]}_{cube[2]}",
            finest=level,
            coarsest=level,
            points=last - first,
            error_m=levels.error_m(level) if below else 0.0,
            min_m=tuple(extent.min(axis=0).tolist()),
            max_m=tuple(extent.max(axis=0).tolist()),
            tiles=(tile,),
            first=first,
            last=last,
            children=tuple(below),
        )
    return nodes
