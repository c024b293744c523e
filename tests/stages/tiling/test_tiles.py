"""Tiles: merging is exact and free of order; points are where the world is."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import PointClass
from scanloom.stages.tiling import tiles
from scanloom.stages.tiling.pieces import Settings as TilingSettings
from scanloom.stages.tiling.tiles import Settings
from tests.stages.mapping import Source, pieces_of, poses_of, tiles_of
from tests.worlds import GROUND_Z_M, drive, street

GEOREFERENCE = {
    "epsg": 32632, "latitude_deg": 48.1, "longitude_deg": 11.6, "height_m": 520.0, "easting_m": 693123.25,
    "northing_m": 5330456.5, "grid_convergence_rad": 0.0337, "point_scale": 0.9999,
}  # fmt: skip


@pytest.fixture(scope="module")
def world():  # type: ignore[no-untyped-def]
    return drive(street(), 6, rows=16, columns=512, step_m=4.0)


def sources(world, cut: int) -> list[Source]:  # type: ignore[no-untyped-def]
    """The drive as two chunks, cut before scan `cut`."""
    scans, T = world
    poses = poses_of(T)
    return [
        Source("a", "0000", pieces_of(scans[:cut], T[:cut], poses=poses)),
        Source("a", "0001", pieces_of(scans[cut:], T[cut:], poses=poses)),
    ]


def test_a_map_does_not_depend_on_chunks(world) -> None:  # type: ignore[no-untyped-def]
    whole = tiles_of([Source("a", "0000", pieces_of(*world))])
    for cut in (1, 4):
        cut_up = tiles_of(sources(world, cut))
        assert cut_up.keys() == whole.keys()
        for name, (tile, files) in whole.items():
            assert cut_up[name][0].to_arrow().equals(tile.to_arrow())
            assert cut_up[name][1].read("tile.ply") == files.read("tile.ply")


def test_a_map_does_not_depend_on_which_session_came_first(world) -> None:  # type: ignore[no-untyped-def]
    one, two = sources(world, 3)
    forward = tiles_of([Source("a", "0000", one.pieces), Source("b", "0000", two.pieces)])
    backward = tiles_of([Source("b", "0000", one.pieces), Source("a", "0000", two.pieces)])
    for name, (tile, _) in forward.items():
        other = backward[name][0].to_arrow()
        assert other.drop("session").equals(tile.to_arrow().drop("session"))
        if len(tile.sessions) == 2:
            assert np.array_equal(backward[name][0].session, 1 - tile.session)
    assert {tile.sessions for tile, _ in forward.values()} >= {("a", "b")}


def test_ground_lies_at_its_height_and_walls_are_static(world) -> None:  # type: ignore[no-untyped-def]
    made = tiles_of([Source("a", "0000", pieces_of(*world))])
    z = np.concatenate([tile.z_m for tile, _ in made.values()])
    classes = np.concatenate([tile.class_ for tile, _ in made.values()])
    ground = z[classes == PointClass.GROUND]
    assert abs(np.median(ground) - GROUND_Z_M) < 0.01
    spread = float(np.std(ground[np.abs(ground - GROUND_Z_M) < 0.1]))
    assert 0.001 < spread < 0.02  # noise of 2 cm along rays that meet the ground at a slant
    assert z[classes == PointClass.STATIC].max() > 2.0


def test_every_voxel_holds_one_point_inside_it(world) -> None:  # type: ignore[no-untyped-def]
    for name, (tile, _) in tiles_of([Source("a", "0000", pieces_of(*world))]).items():
        points = np.column_stack((tile.x_m, tile.y_m, tile.z_m)).astype(float)
        assert points[:, :2].min() >= -1e-4
        assert points[:, :2].max() <= 50.0 + 1e-4
        voxels = np.floor(points / 0.1 + 1e-3).astype(int)
        assert len(np.unique(voxels, axis=0)) >= 0.98 * len(points)
        x, y = (int(v) for v in name.split("_"))
        assert tile.offset_m == (50.0 * x, 50.0 * y, 0.0)


def test_thin_voxels_can_be_left_out(world) -> None:  # type: ignore[no-untyped-def]
    everything = tiles_of([Source("a", "0000", pieces_of(*world))])
    seen_twice = tiles_of([Source("a", "0000", pieces_of(*world))], Settings(min_scans=2))
    assert sum(len(t) for t, _ in seen_twice.values()) < sum(len(t) for t, _ in everything.values())


def test_pieces_of_different_grids_do_not_merge(world) -> None:  # type: ignore[no-untyped-def]
    scans, T = world
    fine = Source("a", "0000", pieces_of(scans[:1], T[:1]))
    coarse = Source("a", "0001", pieces_of(scans[:1], T[:1], TilingSettings(voxel_size_m=0.2)))
    with pytest.raises(StageError, match="different grids"):
        tiles_of([fine, coarse])
    with pytest.raises(StageError):
        tiles(Settings(), Parts([]))


def test_ply_opens_in_open3d_with_offset_and_crs(world, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    import open3d

    scans, T = world
    poses = poses_of(T, georeference=GEOREFERENCE)
    made = tiles_of([Source("a", "0000", pieces_of(scans, T, poses=poses))])
    tile, files = made["0_-1"]
    files.write(tmp_path)
    head = (tmp_path / "tile.ply").read_bytes().split(b"end_header")[0].decode()
    assert "comment offset_m 0.0000 -50.0000 0.0000" in head
    assert "comment crs EPSG:32632" in head
    cloud = open3d.io.read_point_cloud(str(tmp_path / "tile.ply"))
    assert np.allclose(np.asarray(cloud.points), np.column_stack((tile.x_m, tile.y_m, tile.z_m)), atol=0)
    tensor = open3d.t.io.read_point_cloud(str(tmp_path / "tile.ply"))
    assert np.array_equal(tensor.point["class"].numpy()[:, 0], tile.class_)
    assert np.array_equal(tensor.point["intensity"].numpy()[:, 0], tile.intensity)


def test_a_tile_survives_its_file(world, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    tile, _ = tiles_of([Source("a", "0000", pieces_of(*world))])["0_0"]
    tile.write(tmp_path / "tile.parquet")
    back = type(tile).open(tmp_path / "tile.parquet")
    assert back.to_arrow().equals(tile.to_arrow())
    assert tuple(back.offset_m) == tile.offset_m


def test_many_pieces_merge_batch_by_batch(world, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    whole = tiles_of([Source("a", "0000", pieces_of(*world))])
    monkeypatch.setattr(sys.modules["scanloom.stages.tiling.tiles"], "ROWS_AT_ONCE", 0)
    scans, T = world
    poses = poses_of(T)
    chunks = [
        Source("a", f"{i:04}", pieces_of([scan], T[i : i + 1], poses=poses)) for i, scan in enumerate(scans)
    ]
    for name, (tile, _) in tiles_of(chunks).items():
        assert tile.to_arrow().equals(whole[name][0].to_arrow())
