"""The list of tiles and the whole map."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import Tile
from scanloom.stages.geometry import ply
from scanloom.stages.tiling import overview
from scanloom.stages.tiling.overview import Settings, checksum
from tests.stages.mapping import Source, pieces_of, tile_parts, tiles_of
from tests.worlds import drive, street


@pytest.fixture(scope="module")
def tiles() -> Parts[Tile]:
    return tile_parts(tiles_of([Source("a", "0000", pieces_of(*drive(street(), 4, step_m=10.0)))]))


def read_ply(data: bytes) -> np.ndarray:
    head, body = data.split(b"end_header\n", 1)
    count = int(head.split(b"element vertex ")[1].split()[0])
    vertices = np.frombuffer(body, ply.COLOURED if b"red" in head else ply.VERTEX)
    assert len(vertices) == count
    return vertices


def test_index_lists_every_tile_with_its_bounds(tiles: Parts[Tile]) -> None:
    index, _, _ = overview(Settings(), tiles)
    assert index.names == list(index.by_tile())
    assert len(index.names) == len(tiles)
    assert index.points.sum() == sum(len(tile) for tile in tiles)
    by_name = {c["tile"]: tile for c, tile in tiles.items()}
    positions = [tuple(int(v) for v in name.split("_")) for name in index.names]
    assert positions == sorted(positions)
    for name, level, points, first, low, high, digest in zip(
        index.tile, index.level, index.points, index.first_row, index.min_m, index.max_m, index.checksum
    ):
        tile = by_name[name].take(slice(first, first + points))
        assert (tile.level == level).all()
        assert np.allclose(low, np.array([tile.x_m.min(), tile.y_m.min(), tile.z_m.min()]) + tile.offset_m)
        assert (low <= high).all()
        assert digest == checksum(tile)
    assert (index.tile_size_m, index.voxel_size_m) == (50.0, 0.1)


def test_checksum_changes_with_one_bit(tiles: Parts[Tile]) -> None:
    tile = tiles[0]
    changed = tile.intensity.copy()
    changed[0] = np.nextafter(changed[0], np.float32(2))
    assert checksum(tile.take(slice(None))) == checksum(tile)
    assert checksum(type(tile)(**{**vars(tile), "intensity": changed})) != checksum(tile)


def test_the_map_is_the_thinned_union_of_the_tiles(tiles: Parts[Tile]) -> None:
    _, _, files = overview(Settings(map_voxel_size_m=0.5), tiles)
    points = read_ply(files.read("map.ply"))
    everything = np.concatenate(
        [np.column_stack((t.x_m, t.y_m, t.z_m)).astype(float) + t.offset_m for t in tiles]
    )
    xyz = np.column_stack((points["x"], points["y"], points["z"]))
    voxels = np.unique(np.floor(everything / 0.5).astype(int), axis=0)
    assert 0.99 * len(voxels) <= len(xyz) <= 1.01 * len(voxels)
    assert np.abs(xyz.min(axis=0) - everything.min(axis=0)).max() < 0.5
    assert np.abs(xyz.max(axis=0) - everything.max(axis=0)).max() < 0.5


def test_the_map_has_colours_where_one_tile_has_some(tiles: Parts[Tile]) -> None:
    blind = read_ply(overview(Settings(), tiles)[2].read("map.ply"))
    assert "red" not in (blind.dtype.names or ())
    parts = [(tuple(where.items()), tile) for where, tile in tiles.items()]
    one = parts[1][1]
    colour, views = np.zeros((len(one), 3), np.uint8), np.zeros(len(one), np.uint16)
    colour[:], views[:] = (7, 80, 255), 2
    parts[1] = (parts[1][0], replace(one, colour=colour, views=views))
    _, _, files = overview(Settings(), Parts(parts))
    found = read_ply(files.read("map.ply"))
    assert np.array_equal(found[list(blind.dtype.names or ())], blind)
    rgb = np.column_stack([found[name] for name in ("red", "green", "blue")])
    seen = rgb.any(axis=1)
    assert 0 < seen.sum() < len(seen) and (rgb[seen] == (7, 80, 255)).all()
    assert b"red" not in files.read("removed.ply").split(b"end_header")[0]


def test_a_map_as_fine_as_its_tiles_keeps_every_point(tiles: Parts[Tile]) -> None:
    _, _, files = overview(Settings(map_voxel_size_m=0.1), tiles)
    buffer = io.BytesIO()
    files.contents["map.ply"](buffer)  # type: ignore[operator]
    assert len(read_ply(buffer.getvalue())) == sum(len(tile) for tile in tiles)
    assert files.read("map.ply") == buffer.getvalue()


def test_no_tiles_is_an_error_with_advice() -> None:
    with pytest.raises(StageError, match="no tiles") as caught:
        overview(Settings(), Parts([]))
    assert "tiling.classes" in str(caught.value)


def test_the_overview_holds_the_coarsest_levels_that_fit(tiles: Parts[Tile]) -> None:
    everything = sum(len(tile) for tile in tiles)
    index, whole, _ = overview(Settings(overview_points=everything), tiles)
    assert len(whole) == everything
    assert (np.diff(whole.level.astype(int)) <= 0).all()
    levels = sorted(set(index.level.tolist()))
    for finest in levels[1:]:
        fits = int(index.points[index.level >= finest].sum())
        for most, kept in ((fits, finest), (fits - 1, finest + 1)):
            if kept > max(levels):
                continue
            _, some, _ = overview(Settings(overview_points=most), tiles)
            assert some.level.min() == kept
            assert len(some) == index.points[index.level >= kept].sum()
    _, least, _ = overview(Settings(overview_points=1), tiles)
    assert (
        len(least) == index.points[index.level == max(levels)].sum()
    )  # of a map there is always something to see


def test_points_of_the_overview_are_those_of_their_tiles(tiles: Parts[Tile]) -> None:
    index, whole, _ = overview(Settings(), tiles)
    by_name = {c["tile"]: tile for c, tile in tiles.items()}
    for number, name in enumerate(index.names):
        rows = whole.tile == number
        tile = by_name[name]
        assert np.array_equal(whole.x_m[rows], tile.x_m)
        assert np.array_equal(whole.first_ns[rows], tile.first_ns)
    assert set(whole.sessions) == {"a"}
    assert sum(whole.row_groups()) == len(whole)


def test_an_empty_tile_is_on_the_list(tiles: Parts[Tile]) -> None:
    """So that a setting that empties a tile is seen to have altered it."""
    empty = tiles[0].take(slice(0, 0))
    index, cloud, files = overview(Settings(), tile_parts({"7_7": (empty, None), "0_0": (tiles[0], None)}))
    row = index.by_tile()["7_7"]
    assert index.points[row].tolist() == [0]
    assert index.level[row].tolist() == [0]
    assert len(cloud) == index.points.sum()
    assert len(read_ply(files.read("map.ply"))) > 0
