"""A tile without points stays on the map's list, at height 0: no export may take that place for one of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanloom.schemas.tiles import Tile, TileIndex
from scanloom.stages.exports.clouds import box_of, part_boxes, round_offset_m
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from tests.delivered import cut, index_of, write_map

POINTS = np.random.default_rng(3).uniform((2.0, 3.0, 410.0), (98.0, 45.0, 430.0), (500, 3))
FAR = (9000.0, 0.0, 0.0)


@pytest.fixture
def source(tmp_path) -> MapSource:
    tiles = cut(POINTS)
    write_map(tmp_path, tiles)
    empty = replace(next(iter(tiles.values())).take(slice(0, 0)), offset_m=FAR)
    empty.write(tmp_path / "tiles" / "180_0.parquet")
    with_empty(index_of(tiles)).write(tmp_path / "tiles" / "index.parquet")
    return MapSource.open(tmp_path)


def with_empty(index: TileIndex) -> TileIndex:
    last = {name: getattr(index.take(slice(-1, None)), name) for name in ("level", "sessions", "checksum")}
    none = np.zeros(1, np.int64)
    more = {
        "tile": np.array(["180_0"], object),
        "points": none,
        "first_row": none,
        "min_m": np.array([FAR]),
        "max_m": np.array([FAR]),
    }
    return replace(
        index, **{name: np.concatenate((getattr(index, name), rows)) for name, rows in (last | more).items()}
    )


def test_bounds_are_those_of_the_points(source):
    assert source.tile_names == ["0_0", "1_0", "180_0"]
    np.testing.assert_allclose(source.index.bounds_m, [POINTS.min(axis=0), POINTS.max(axis=0)], atol=1e-4)
    empty = source.index.take(source.index.points == 0)
    np.testing.assert_array_equal(empty.bounds_m, np.zeros((2, 3)))


def test_exports_neither_reach_there_nor_start_between(source):
    assert list(part_boxes(source, Options())) == ["0_0", "1_0"]
    projector = Projector.of(source, Options())
    low, high = box_of(source, projector, Options())
    assert (high - low < (110.0, 60.0, 25.0)).all()
    assert round_offset_m(source, projector)[2] == 400.0
    assert isinstance(source.tile("180_0"), Tile)
