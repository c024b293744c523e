"""Pieces against sums taken the slow way; borders, negative tiles, skipped points."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.errors import StageError
from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass, ScanLabels
from scanloom.schemas.tiles import LEFT_OUT, RANK_SHIFT, Piece
from scanloom.stages.geometry.se3 import F8, pose, so3_exp, transform
from scanloom.stages.tiling import tiling
from scanloom.stages.tiling.pieces import Settings
from scanloom.stages.tiling.voxel_sums import STEP_M, voxel_indices
from tests.stages.mapping import pieces_of, poses_of, stamps
from tests.worlds import drive, street


def cloud(points: F8, index: int = 0, intensity: float = 0.5) -> DeskewedScan:
    xyz = np.asarray(points, np.float32).reshape(-1, 3)
    n = len(xyz)
    return DeskewedScan(
        x_m=xyz[:, 0].copy(), y_m=xyz[:, 1].copy(), z_m=xyz[:, 2].copy(),
        intensity=np.full(n, intensity, np.float32),
        reference_ns=int(stamps(index + 1)[-1]), scan_index=index,
    )  # fmt: skip


def label(scan: DeskewedScan, classes: object = PointClass.STATIC) -> ScanLabels:
    values = np.broadcast_to(np.asarray(classes, np.uint8), len(scan)).copy()
    return ScanLabels(class_=values, reference_ns=scan.reference_ns, scan_index=scan.scan_index)


def place(
    points: F8, settings: Settings | None = None, classes: object = PointClass.STATIC
) -> dict[str, Piece]:
    """Pieces of one scan at the origin."""
    scan = cloud(points)
    made = tiling(
        settings or Settings(),
        Deskewed([scan]),
        FinalLabels([label(scan, classes)]),
        poses_of(np.eye(4)[None]),
    )
    return {part.key: part.product for part in made}


def test_sums_equal_those_taken_point_by_point() -> None:
    scans, T = drive(street(), 3, rows=8, columns=256, step_m=3.0, yaw_step_rad=0.1)
    T = pose(so3_exp([0, 0, 0.3]), [-20.0, 7.0, 1.0]) @ T
    settings = Settings(voxel_size_m=0.5, tile_size_m=20.0)
    got = {}
    for part in pieces_of(scans, T, settings):
        x, y = (int(v) for v in part.key.split("_"))
        piece = part.product
        sums = np.column_stack((piece.sum_x_m, piece.sum_y_m, piece.sum_z_m))
        for voxel, count, total in zip(voxel_indices(piece.voxel), piece.count, sums):
            got[(x, y, *voxel)] = (count, total)
    want: dict[tuple[int, ...], list[F8]] = {}
    for scan, pose_ in zip(scans, T):
        for point in transform(pose_, scan.points()):
            tile = np.floor(point[:2] / 20.0)
            local = point - np.array([*tile * 20.0, 0.0])
            voxel = np.floor(local / 0.5).astype(int)
            want.setdefault((*tile.astype(int), *voxel), []).append(local)
    assert got.keys() == want.keys()
    for key, points in want.items():
        count, total = got[key]
        assert count == len(points)
        assert np.abs(total - np.sum(points, axis=0)).max() <= 0.51 * STEP_M * len(points)


def test_points_on_borders_belong_to_the_tile_above() -> None:
    pieces = place(np.array([[50.0, 0.0, 0.0], [49.99, -0.01, -0.01], [-50.0, -50.0, 3.0], [0.0, 50.0, 0.1]]))
    assert sorted(pieces) == ["-1_-1", "0_-1", "0_1", "1_0"]
    assert voxel_indices(pieces["1_0"].voxel).tolist() == [[0, 0, 0]]
    assert voxel_indices(pieces["0_-1"].voxel).tolist() == [[499, 499, -1]]
    assert voxel_indices(pieces["-1_-1"].voxel).tolist() == [[0, 0, 30]]


def test_a_hair_below_zero_stays_in_the_last_voxel() -> None:
    piece = place(np.array([[-1e-20, 1.0, 0.0]]))["-1_0"]
    assert voxel_indices(piece.voxel).tolist() == [[499, 10, 0]]


def test_pieces_come_ordered_and_repeat_bit_for_bit() -> None:
    scans, T = drive(street(), 4, rows=8, columns=256, step_m=5.0)
    first, second = pieces_of(scans, T), pieces_of(scans, T)
    keys = [tuple(int(v) for v in part.key.split("_")) for part in first]
    assert keys == sorted(keys)
    assert any(x < 0 for x, _ in keys)
    assert any(y < 0 for _, y in keys)
    for a, b in zip(first, second):
        assert a.product.sum_x_m.tobytes() == b.product.sum_x_m.tobytes()
        voxels = [tuple(v) for v in voxel_indices(a.product.voxel)]
        assert [*a.product.voxel] == sorted(a.product.voxel)
        assert voxels == sorted(voxels)
        assert len(set(voxels)) == len(voxels)


def test_what_is_left_out_has_rows_of_its_own() -> None:
    points = np.array([[1.0, 1, 0], [2, 1, 0], [3, 1, 0], [4, 1, 0], [2, 1, 0.01]])
    classes = [PointClass.GROUND, PointClass.DYNAMIC, PointClass.STATIC, PointClass.EGO, PointClass.CHANGED]
    piece = place(points, classes=classes)["0_0"]
    rank = piece.voxel >> RANK_SHIFT
    assert rank.tolist() == [
        0,
        0,
        1 + LEFT_OUT.index(PointClass.DYNAMIC),
        1 + LEFT_OUT.index(PointClass.CHANGED),
    ]
    assert (np.diff(piece.voxel) > 0).all()
    assert piece.ground_count.tolist() == [1, 0, 0, 0]
    assert len(set(piece.voxel[2:] & ((1 << RANK_SHIFT) - 1))) == 1


def test_a_class_that_enters_the_map_is_not_left_out() -> None:
    settings = Settings(classes=(PointClass.STATIC, PointClass.DYNAMIC))
    piece = place(np.array([[1.0, 1, 0], [2, 1, 0]]), settings, [PointClass.STATIC, PointClass.DYNAMIC])[
        "0_0"
    ]
    assert (piece.voxel >> RANK_SHIFT).tolist() == [0, 0]


def test_scan_count_counts_scans_not_points() -> None:
    points = np.array([[1.01, 1.01, 0.01], [1.02, 1.02, 0.02]])
    scans = [cloud(points, 0), cloud(points, 1), cloud(points[:1], 2)]
    T = np.tile(np.eye(4), (3, 1, 1))
    (part,) = tiling(Settings(), Deskewed(scans), FinalLabels([label(s) for s in scans]), poses_of(T))
    assert (part.product.count[0], part.product.scan_count[0]) == (5, 3)


def test_points_that_are_not_finite_and_scans_without_pose_are_skipped() -> None:
    scans = [cloud(np.array([[1.0, 1, 0], [np.nan, 0, 0], [np.inf, 0, 0]]), 0), cloud(np.ones((4, 3)), 7)]
    made = tiling(
        Settings(), Deskewed(scans), FinalLabels([label(s) for s in scans]), poses_of(np.eye(4)[None])
    )
    assert sum(int(part.product.count.sum()) for part in made) == 1


def test_no_pose_at_all_and_foreign_labels_are_errors() -> None:
    scan = cloud(np.ones((4, 3)), 3)
    with pytest.raises(StageError, match="no scan of this chunk has a pose"):
        list(tiling(Settings(), Deskewed([scan]), FinalLabels([label(scan)]), poses_of(np.eye(4)[None])))
    other = ScanLabels(class_=np.zeros(3, np.uint8), reference_ns=0, scan_index=3)
    with pytest.raises(StageError, match="do not belong"):
        list(tiling(Settings(), Deskewed([scan]), FinalLabels([other]), poses_of(np.eye(4)[None])))


def test_diverged_poses_are_named() -> None:
    with pytest.raises(StageError, match="km from the origin"):
        place(np.array([[2e5, 0.0, 0.0]]))


def test_an_empty_chunk_gives_no_pieces() -> None:
    assert list(tiling(Settings(), Deskewed([]), FinalLabels([]), poses_of(np.eye(4)[None]))) == []
    assert place(np.empty((0, 3))) == {}


@pytest.mark.parametrize(("tile", "voxel"), [(50.0, 0.3), (1000.0, 0.1), (1.0, 2.0)])
def test_grids_that_do_not_fit_are_refused(tile: float, voxel: float) -> None:
    with pytest.raises(ValidationError):
        Settings(tile_size_m=tile, voxel_size_m=voxel)


def test_the_table_grows_without_losing_a_point() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-80, 80, (200_000, 3)) * [1, 1, 0.05]
    pieces = place(points)
    assert sum(int(piece.count.sum()) for piece in pieces.values()) == len(points)
    assert 150_000 < sum(len(piece) for piece in pieces.values()) <= len(points)
