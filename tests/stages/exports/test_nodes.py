"""Nodes: together they hold every point of the map exactly once, coarse ones first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanloom.schemas.errors import InvalidInput, ProductError
from scanloom.schemas.tiles import spacing_m
from scanloom.stages.exports.node_points import NodeReader, Recent
from scanloom.stages.exports.nodes import CELL_BITS, Levels, Node, door_level, tile_nodes, tree
from scanloom.stages.exports.source import MapSource
from tests.delivered import cut, index_of, write_map


def reader_of(
    folder: Path, points: np.ndarray, *, root_points: int, overview_points: int = 4_000_000, **grid: float
):
    tiles = cut(points, columns={"intensity": np.arange(len(points), dtype=np.float32)}, **grid)
    write_map(folder, tiles, overview_points=overview_points)
    return NodeReader(MapSource.open(folder), root_points=root_points)


def nodes_of(reader: NodeReader) -> Iterator[Node]:
    """All nodes, doors opened."""
    for node in reader.root.walk():
        yield node
        if node.door:
            for top in reader.within(node.name):
                yield from top.walk()


def scattered(seed: int, count: int, spread_m: float, height_m: float) -> np.ndarray:
    """A surface with some height, as float32 keeps it; some points on the borders of tiles."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-spread_m, spread_m, (count, 3)) * (1.0, 1.0, height_m / spread_m)
    border = rng.random(count) < 0.05
    points[border, 0] = np.round(points[border, 0] / 10.0) * 10.0
    return points.astype(np.float32).astype(np.float64)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 2_000),
    tiles=st.sampled_from((0.1, 0.9, 2.5)),
    height=st.sampled_from((0.5, 20.0, 90.0)),
    root_points=st.sampled_from((1, 100, 1_000, 50_000)),
    overview_points=st.sampled_from((1, 300, 4_000_000)),
    grid=st.sampled_from(((10.0, 0.02), (50.0, 0.1), (20.0, 0.5), (25.6, 0.1))),
)
def test_every_point_is_in_exactly_one_node(
    tmp_path_factory, seed, count, tiles, height, root_points, overview_points, grid
) -> None:
    tile, voxel = grid
    points = scattered(seed, count, tiles * tile, height)
    reader = reader_of(
        tmp_path_factory.mktemp("map") / "m", points, root_points=root_points, overview_points=overview_points,
        tile_size_m=tile, voxel_size_m=voxel,
    )  # fmt: skip
    seen, got = [], []
    for node in nodes_of(reader):
        if not node.points:
            continue
        held = reader.points(node)
        assert len(held) == node.points
        assert (held.xyz_m >= np.array(node.min_m) - 1e-5).all()
        assert (held.xyz_m <= np.array(node.max_m) + 1e-5).all()
        seen.append(held.columns["intensity"])
        got.append(held.xyz_m)
    numbers = np.concatenate(seen).astype(int)
    assert sorted(numbers) == list(range(count))
    # Tiles keep coordinates as float32 from their own origin.
    assert np.abs(np.concatenate(got) - points[numbers]).max() < 1e-5


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), root_points=st.sampled_from((1, 200)))
def test_children_lie_in_their_parents_and_are_finer(tmp_path_factory, seed, root_points) -> None:
    points = scattered(seed, 2_000, 40.0, 10.0)
    reader = reader_of(tmp_path_factory.mktemp("map") / "m", points, root_points=root_points)
    names = [node.name for node in nodes_of(reader)]
    assert len(names) == len(set(names))
    for node in nodes_of(reader):
        below = node.children if not node.door else reader.within(node.name)
        assert bool(below) == (node.error_m > 0)
        for child in below:
            assert (np.array(child.min_m) >= np.array(node.min_m) - 1e-5).all()
            assert (np.array(child.max_m) <= np.array(node.max_m) + 1e-5).all()
            assert child.error_m <= node.error_m
            assert child.finest < node.finest or child.door or node.door


def test_a_node_is_128_cells_wide(tmp_path) -> None:
    dense = np.random.default_rng(3).uniform((0, 0, 0), (14, 14, 0.2), (20_000, 3))
    points = np.concatenate((scattered(3, 6_000, 60.0, 10.0), dense))
    reader = reader_of(tmp_path / "m", points, root_points=1)
    widest: dict[int, float] = {}
    for node in nodes_of(reader):
        if node.name != "root" and not node.door and node.points:
            xyz = reader.points(node).xyz_m
            wide = max(np.ptp(xyz[:, 0]), np.ptp(xyz[:, 1]))
            widest[node.finest] = max(widest.get(node.finest, 0.0), wide)
            cell = 50.0 / 2.0 ** (9 - node.finest)
            assert wide <= 2**CELL_BITS * cell + 1e-4
    assert widest[0] > 8.0  # 12.5 m
    assert widest[2] > 40.0  # a tile
    assert set(widest) >= {0, 1, 2, 3, 4}


def test_points_down_to_a_level_are_as_dense_as_it_says(tmp_path) -> None:
    """Every cell of a level that has a point anywhere has one at that level or above."""
    points = scattered(5, 8_000, 40.0, 2.0)
    reader = reader_of(tmp_path / "m", points, root_points=1)
    for level in (2, 3, 5):
        cell = spacing_m(level, 50.0, 0.1)
        shown = np.concatenate(
            [reader.points(n).xyz_m for n in nodes_of(reader) if n.points and n.finest >= level]
        )
        cells = {tuple(c) for c in np.floor(shown / cell).astype(int).tolist()}
        assert cells == {tuple(c) for c in np.floor(points / cell).astype(int).tolist()}
        assert len(cells) == len(shown)


def test_one_tile_one_point(tmp_path) -> None:
    reader = reader_of(tmp_path / "m", np.array([[1.0, 2.0, 3.0]]), root_points=50_000)
    assert [n.name for n in nodes_of(reader)] == ["root"]
    assert reader.root.points == 1 and reader.root.error_m == 0.0
    assert np.allclose(reader.points(reader.root).xyz_m, [[1.0, 2.0, 3.0]])


def test_root_takes_whole_levels_up_to_its_limit() -> None:
    levels = Levels.of(index_of(cut(scattered(7, 5_000, 60.0, 5.0))))
    down_to = np.cumsum(levels.points.sum(axis=0)[::-1])[::-1]
    for level in range(levels.top + 1):
        assert tree(levels, int(down_to[level])).points == down_to[level]
        if level and down_to[level - 1] > down_to[level]:
            assert tree(levels, int(down_to[level - 1]) - 1).points == down_to[level]


def test_a_map_of_small_tiles_has_no_doors() -> None:
    levels = Levels.of(index_of(cut(scattered(7, 500, 60.0, 5.0), tile_size_m=10.0, voxel_size_m=0.5)))
    assert levels.of_tile < 0
    assert door_level(levels, 1) == -1
    assert not any(node.door for node in tree(levels, 1).walk())


def test_rows_out_of_order_are_refused() -> None:
    tiles = cut(np.add(scattered(9, 2_000, 20.0, 5.0), (25.0, 25.0, 0.0)))
    levels = Levels.of(index_of(tiles))
    tile = tiles["0_0"]
    xyz = np.column_stack((tile.x_m, tile.y_m, tile.z_m)).astype(float)
    in_order = [xyz[tile.level == level] for level in range(10)]
    assert sum(n.points for top in tile_nodes(levels, 0, in_order, 1) for n in top.walk()) == len(
        in_order[0]
    ) + len(in_order[1])
    mixed = [np.random.default_rng(0).permutation(points) for points in in_order]
    with pytest.raises(ProductError, match="not in order"):
        tile_nodes(levels, 0, mixed, 1)


def test_sessions_are_numbered_alike_in_all_tiles(tmp_path) -> None:
    first = cut(np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0]]), sessions=("b",))
    second = cut(
        np.array([[60.0, 1.0, 0.0], [61.0, 1.0, 0.0]]), sessions=("a", "b"),
        columns={"session": np.array([0, 1], np.uint16)},
    )  # fmt: skip
    write_map(tmp_path / "m", first | second, overview_points=0)
    reader = NodeReader(MapSource.open(tmp_path / "m"))
    held = reader.points(reader.root)
    assert reader.sessions == ["a", "b"]
    named = {
        tuple(np.round(p).tolist()): reader.sessions[s] for p, s in zip(held.xyz_m, held.columns["session"])
    }
    assert named == {(1, 1, 0): "b", (2, 2, 0): "b", (60, 1, 0): "a", (61, 1, 0): "b"}


def test_an_overview_of_another_map_is_refused(tmp_path) -> None:
    tiles = cut(scattered(1, 300, 60.0, 5.0))
    write_map(tmp_path / "m", tiles)
    some = next(iter(tiles.values()))
    from tests.delivered import overview_of

    overview_of({"0_0": replace(some)}, 10_000).write(tmp_path / "m" / "tiles" / "overview.parquet")
    with pytest.raises(InvalidInput, match="overview"):
        NodeReader(MapSource.open(tmp_path / "m"))


def test_memory_of_what_was_read_lately_is_bounded() -> None:
    recent, made = Recent(100), []

    def make(key: int):
        def value() -> tuple[int, int]:
            made.append(key)
            return key, 40

        return value

    for key in (1, 2, 1, 3, 1, 2):
        assert recent.get(key, make(key)) == key
        assert recent.bytes <= 100
    assert made == [1, 2, 3, 2]  # 2 had to go for 3, 1 was used in between
