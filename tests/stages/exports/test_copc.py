"""COPC, read with laspy and copclib: every point once, in a node that holds its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as effort
from hypothesis import strategies as st

from scanloom.schemas.errors import StageError
from scanloom.stages.exports import copc_file
from scanloom.stages.exports.autoware import write_autoware
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.copc import write_copc
from scanloom.stages.exports.copc_file import ANOTHER_PAGE, ENTRY, pages_of
from scanloom.stages.exports.las import write_laz
from scanloom.stages.exports.octree import Octree
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from tests.delivered import index_of
from tests.stages.exports.clouds import (
    MUNICH,
    PUNTA_ARENAS,
    add_removed,
    column,
    expected,
    scattered,
    sorted_rows,
    write,
)
from tests.tiles import tile_of

laspy = pytest.importorskip("laspy")


def read(path: Path) -> tuple[object, np.ndarray]:
    """Header and points (n, 3) by the octree's reader."""
    with laspy.CopcReader.open(str(path)) as reader:
        found = reader.query()
        return reader.header, np.column_stack((found.x, found.y, found.z))


def nodes(path: Path) -> dict[tuple[int, int, int, int], np.ndarray]:
    """Points (n, 3) of every node, by copclib."""
    copclib = pytest.importorskip("copclib")
    reader = copclib.FileReader(str(path))
    out = {}
    for node in reader.GetAllNodes():
        points = reader.GetPoints(node)
        out[node.key.d, node.key.x, node.key.y, node.key.z] = np.column_stack((points.x, points.y, points.z))
    return out


def clustered(seed: int, n: int) -> np.ndarray:
    """Points that are dense in three places of different tiles, and thin between them."""
    rng = np.random.default_rng(seed)
    places = np.array([[30.0, -20.0, 2.0], [-60.0, 71.0, 4.0], [12.0, 49.5, 1.0]])
    dense = places[rng.integers(0, 3, n)] + rng.normal(scale=0.8, size=(n, 3))
    return np.concatenate((dense, scattered(seed, n // 10)))


@pytest.mark.parametrize(
    ("origin", "far_m"),
    [(MUNICH, (0.0, 0.0)), (PUNTA_ARENAS, (0.0, 0.0)), (MUNICH, (-60_000.0, 41_000.0)), (None, (0.0, 0.0))],
)
def test_points_bounds_and_system(tmp_path: Path, origin, far_m: tuple[float, float]) -> None:
    source = write(tmp_path / "m", scattered(1, far_m=far_m), origin)
    projector = Projector.of(source, Options())
    header, points = read(write_copc(source, tmp_path, Options())[0])
    right = expected(source, projector)
    assert len(points) == source.points == header.point_count == header.number_of_points_by_return[0]
    assert np.abs(sorted_rows(np.round(points, 3)) - sorted_rows(np.round(right, 3))).max() < 0.0011
    assert np.abs(header.mins - right.min(axis=0)).max() < 0.00052
    assert np.abs(header.maxs - right.max(axis=0)).max() < 0.00052
    assert header.parse_crs() == projector.crs


def test_it_holds_the_records_of_the_laz(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(2))
    plain = laspy.read(write_laz(source, tmp_path, Options())[0]).points.array
    tree = laspy.read(write_copc(source, tmp_path, Options())[0]).points.array
    assert plain.dtype == tree.dtype
    assert np.array_equal(np.sort(plain, order=plain.dtype.names), np.sort(tree, order=plain.dtype.names))


def test_info_record(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(3))
    path = write_copc(source, tmp_path, Options())[0]
    times = laspy.read(path).gps_time
    with laspy.CopcReader.open(str(path)) as reader:
        info = reader.copc_info
        assert info.gps_min == times.min() and info.gps_max == times.max()
        assert info.spacing == 2.0 * info.halfsize / 128
        assert np.all(info.center - info.halfsize <= reader.header.mins)
        assert np.all(info.center + info.halfsize >= reader.header.maxs)
    raw = path.read_bytes()[375 : 375 + 54]
    assert raw[2:6] == b"copc" and raw[18:22] == b"\x01\x00\xa0\x00"


def test_nodes_hold_their_places_and_hang_together(tmp_path: Path) -> None:
    source = write(tmp_path / "m", clustered(4, 6000))
    path = write_copc(source, tmp_path, Options())[0]
    with laspy.CopcReader.open(str(path)) as reader:
        corner, size = reader.copc_info.center - reader.copc_info.halfsize, 2.0 * reader.copc_info.halfsize
    found = nodes(path)
    assert sum(map(len, found.values())) == source.points and max(key[0] for key in found) >= 4
    for (depth, *cell), points in found.items():
        low = corner + np.array(cell) * size / 2**depth
        assert np.all(points >= low - 1e-6) and np.all(points < low + size / 2**depth + 1e-6)
        assert depth == 0 or (depth - 1, *(c >> 1 for c in cell)) in found


def test_a_level_is_the_map_thinned(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    ground = np.column_stack((rng.uniform(0.0, 50.0, (60_000, 2)), rng.uniform(0.0, 0.05, 60_000)))
    source = write(tmp_path / "m", ground)
    with laspy.CopcReader.open(str(write_copc(source, tmp_path, Options())[0])) as reader:
        counts = [len(reader.query(level=range(0, depth + 1))) for depth in range(4)]
        spacing = reader.copc_info.spacing
    assert counts[-1] == 60_000
    # One point per cell of a plane: area over spacing squared, less where the map itself is thinner.
    assert 0.7 * 2500 / spacing**2 < counts[0] < 1.6 * 2500 / spacing**2
    assert 2.0 < counts[1] / counts[0] < 4.5


@pytest.mark.parametrize("corner", [(-70.0, 60.0, -5.0), (20.0, -30.0, 0.0), (5.0, 40.0, -1.0)])
def test_a_box_is_found_by_the_octree(tmp_path: Path, corner: tuple[float, float, float]) -> None:
    source = write(tmp_path / "m", clustered(13, 3000))
    path = write_copc(source, tmp_path, Options())[0]
    low = Projector.of(source, Options()).project(corner)[0]
    high = low + np.array([22.0, 25.0, 12.0])
    with laspy.CopcReader.open(str(path)) as reader:
        found = reader.query(laspy.copc.Bounds(mins=low, maxs=high))
    _, every = read(path)
    inside = np.all((every >= low) & (every <= high), axis=1)
    assert len(found) == inside.sum() > 100


def test_one_point(tmp_path: Path) -> None:
    source = write(tmp_path / "m", np.array([[-0.5, -120.25, 3.0]]))
    _, points = read(write_copc(source, tmp_path, Options())[0])
    assert np.abs(points - expected(source, Projector.of(source, Options()))).max() < 0.00052


def test_a_lonely_point_far_away_is_found(tmp_path: Path) -> None:
    points = np.concatenate((scattered(6, 500, reach_m=20.0), [[3000.0, -2000.0, 400.0]]))
    source = write(tmp_path / "m", points)
    path = write_copc(source, tmp_path, Options())[0]
    assert len(read(path)[1]) == 501
    assert len(nodes(path)[0, 0, 0, 0]) >= 2


def test_removed_points_outside_the_map_come_too(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(7, 300, reach_m=10.0))
    add_removed(tmp_path / "m", np.array([[49.0, 49.0, 900.0], [1.0, 48.0, -90.0], [30.0, 2.0, 5.0]]))
    header, points = read(write_copc(source, tmp_path, Options(removed=True))[0])
    assert len(points) == 303 and header.maxs[2] - header.mins[2] == pytest.approx(990.0, abs=0.2)


def test_an_empty_tile_among_others(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(8, 400))
    tile = source.tile("0_0")
    tile.take(slice(0, 0)).write(tmp_path / "m/tiles/0_0.parquet")
    _, points = read(write_copc(MapSource.open(tmp_path / "m"), tmp_path, Options())[0])
    assert len(points) == 400 - len(tile) > 0


@pytest.mark.parametrize("write_format", [write_copc, write_autoware])
def test_points_where_the_index_has_none_are_no_small_matter(tmp_path: Path, write_format) -> None:
    source = write(tmp_path / "m", scattered(8, 400))
    tile = source.tile("0_0")
    replace(tile, offset_m=(0.0, 700.0, 0.0)).write(tmp_path / "m/tiles/0_0.parquet")
    with pytest.raises(StageError, match=f"{len(tile)} points of 400"):
        write_format(MapSource.open(tmp_path / "m"), tmp_path, Options())


def test_little_memory_gives_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scanloom.stages.exports import blocks

    source = write(tmp_path / "m", scattered(9, 3000))
    bytes_of = []
    for name, budget in (("one", blocks.BUDGET_BYTES), ("two", 1)):
        monkeypatch.setattr(blocks, "BUDGET_BYTES", budget)
        (tmp_path / name).mkdir()
        bytes_of.append(write_copc(source, tmp_path / name, Options())[0].read_bytes())
    assert bytes_of[0] == bytes_of[1]


def test_batches_do_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write(tmp_path / "m", scattered(10, 1000))
    bytes_of = []
    for name, at_once in (("one", copc_file.AT_ONCE_BYTES), ("two", 0)):
        monkeypatch.setattr(copc_file, "AT_ONCE_BYTES", at_once)
        (tmp_path / name).mkdir()
        bytes_of.append(write_copc(source, tmp_path / name, Options())[0].read_bytes())
    assert bytes_of[0] == bytes_of[1]


def test_pages_of_a_deep_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copc_file, "PAGE_DEPTH", 2)
    source = write(tmp_path / "m", clustered(11, 5000))
    path = write_copc(source, tmp_path, Options())[0]
    assert len(read(path)[1]) == 5500
    assert sum(map(len, nodes(path).values())) == 5500
    with laspy.CopcReader.open(str(path)) as reader:
        assert reader.copc_info.hierarchy_root_size < 32 * len(nodes(path))


def test_pages_point_to_each_other() -> None:
    entries = np.zeros(4, ENTRY)
    entries["level"], entries["x"], entries["points"] = [0, 5, 10, 11], [0, 3, 101, 202], 7
    root, five, ten = pages_of(entries, 1000)
    assert root["points"].tolist() == [7, ANOTHER_PAGE] and five["points"].tolist() == [7, ANOTHER_PAGE]
    assert root["offset"][1] == 1000 + root.nbytes and root["bytes"][1] == five.nbytes
    assert five["offset"][1] == 1000 + root.nbytes + five.nbytes and five["bytes"][1] == ten.nbytes
    assert ten["level"].tolist() == [10, 11]


@effort(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 400), spread=st.floats(0.5, 24.0))
def test_no_node_hangs_below_an_empty_one(seed: int, n: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    tile = tile_of(25.0 + rng.normal(scale=spread / 3.0, size=(n, 3)).clip(-24.9, 24.9))
    places = np.rint(1000.0 * np.column_stack((tile.x_m, tile.y_m, tile.z_m))).astype(np.int64)
    octree = Octree.over(index_of({"0_0": tile}), places.min(axis=0) - 3000, places.max(axis=0) + 2000, 0.001)
    levels = octree.levels(places, tile.level)
    # Thinned further, never moved back; a few points only are raised.
    assert np.all(levels >= np.minimum(tile.level, octree.top))
    occupied = [set(map(tuple, octree.cells(places[levels == k], k))) for k in range(octree.top + 1)]
    for k in range(octree.top):
        assert {tuple(c >> 1 for c in cell) for cell in occupied[k]} <= occupied[k + 1]
    for k, cells in enumerate(occupied):
        assert all(0 <= c < 2 ** (octree.top - k) for cell in cells for c in cell)


def test_classes_are_those_of_the_map(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(12, 200))
    found = laspy.read(write_copc(source, tmp_path, Options())[0])
    assert (
        np.bincount(found.classification)[1:].tolist()
        == np.bincount(column(source, "class_"))[:0:-1].tolist()
    )
