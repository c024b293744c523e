"""Change detection: what left is found, what stays is not, and what only moved past is neither."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from scanloom.schemas.base import Base
from scanloom.schemas.changes import ChangeFiles, Changes
from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass, ScanLabels
from scanloom.schemas.tiles import Piece
from scanloom.schemas.trajectory import Poses
from scanloom.stages.changes.objects import objects_of
from scanloom.stages.changes.points import standing_points
from scanloom.stages.changes.rays import fill, judge, new_image
from scanloom.stages.changes.stage import Settings, changes
from scanloom.stages.geometry.se3 import transform
from scanloom.stages.tiling import tiling
from scanloom.stages.tiling.pieces import Settings as TilingSettings
from tests.worlds import GROUND_Z_M, BoxWorld, drive, observe, street

HOUSES = street(3, length_m=50).boxes
HOUSES = HOUSES[HOUSES[:, 1, 2] > GROUND_Z_M + 2.5]
CAR = np.array([[14.0, 3.0, GROUND_Z_M], [18.3, 4.8, GROUND_Z_M + 1.5]])
POLE = np.array([[10.0, -4.0, GROUND_Z_M], [10.25, -3.75, GROUND_Z_M + 3.0]])
STAYS = np.array([[20.0, -5.0, GROUND_Z_M], [24.0, -3.2, GROUND_Z_M + 1.5]])


def world(*boxes: np.ndarray) -> BoxWorld:
    return BoxWorld(np.concatenate((HOUSES, np.array([STAYS, *boxes]))))


class Day:
    """A session: scans with labels, true poses, pieces."""

    def __init__(self, scans: list[DeskewedScan], T: np.ndarray) -> None:
        self.scans = scans
        n = len(scans)
        self.poses = Poses(
            np.arange(n), np.array([s.reference_ns for s in scans]), T, np.zeros((n, 6, 6)), np.ones(n, bool),
            "map", None,
        )  # fmt: skip
        self.labels = [self._label(scan, pose) for scan, pose in zip(scans, T, strict=True)]

    @staticmethod
    def _label(scan: DeskewedScan, T: np.ndarray) -> ScanLabels:
        z = scan.points() @ T[2, :3] + T[2, 3]
        kind = np.where(z < GROUND_Z_M + 0.12, PointClass.GROUND, PointClass.STATIC).astype(np.uint8)
        return ScanLabels(kind, scan.reference_ns, scan.scan_index)

    def pieces(self) -> Iterator[Part[Piece]]:
        return tiling(
            TilingSettings(tile_size_m=20.0), Deskewed(self.scans), FinalLabels(self.labels), self.poses
        )


def day(where: BoxWorld, seed: int, count: int = 32) -> Day:
    return Day(*drive(where, count, step_m=0.8, seed=seed))


def found(
    old: Day, new: Day, *, base: bool = True, settings: Settings | None = None
) -> tuple[Changes, ChangeFiles]:
    days = {"new": new, "old": old}
    blank = Base.empty(frame="", georeference=None)
    pieces = [
        ((("chunk", "0"), ("session", name), ("tile", part.key)), part.product)
        for name, d in days.items()
        for part in d.pieces()
    ]

    def by_chunk(of: dict[str, object]) -> Parts:
        return Parts([((("chunk", "0"), ("session", name)), product) for name, product in of.items()])

    def by_session(of: dict[str, object]) -> Parts:
        return Parts([((("session", name),), product) for name, product in of.items()])

    return changes(
        settings or Settings(),
        by_session({"old": Base.of(old.poses) if base else blank, "new": blank}),
        by_session({name: d.poses for name, d in days.items()}),
        by_chunk({name: Deskewed(d.scans) for name, d in days.items()}),
        by_chunk({name: FinalLabels(d.labels) for name, d in days.items()}),
        Parts(pieces),
    )


def points_of(table: Changes) -> np.ndarray:
    return np.column_stack((table.x_m, table.y_m, table.z_m))


def within(points: np.ndarray, box: np.ndarray, around: float = 0.3) -> np.ndarray:
    return np.asarray(((points > box[0] - around) & (points < box[1] + around)).all(axis=1))


def test_a_car_that_left_is_one_object_and_nothing_else_is() -> None:
    table, files = found(day(world(CAR, POLE), 0), day(world(POLE), 1))
    assert set(table.object_) == {0} and within(points_of(table), CAR).all()
    assert 40 < len(table) < 1000
    assert (table.through >= 3).all() and (table.confirming <= 0.25 * table.through).all()
    assert tuple(table.sessions) == ("new",) and table.frame == "map"
    assert files.read("changes.ply").startswith(b"ply\nformat binary_little_endian 1.0\n")


def test_what_cleaning_took_out_because_it_changed_is_still_found() -> None:
    old, new = day(world(CAR, POLE), 0), day(world(POLE), 1)
    plain, _ = found(old, new)
    for scan, label, T in zip(old.scans, old.labels, old.poses.T_world_lidar, strict=True):
        car = within(transform(T, scan.points().astype(float)), CAR, 0.1)
        label.class_[car & (label.class_ == PointClass.STATIC)] = PointClass.CHANGED
    table, _ = found(old, new)
    assert set(table.object_) == {0}
    assert len(table) >= 0.9 * len(plain)


def test_nothing_left_nothing_reported() -> None:
    table, _ = found(day(world(CAR, POLE), 0), day(world(CAR, POLE), 1))
    assert len(table) == 0 and table.remnants == 0


def test_what_is_new_is_no_change_of_the_old_map() -> None:
    table, _ = found(day(world(POLE), 0), day(world(CAR, POLE), 1))
    assert len(table) == 0


def test_a_pole_that_left_is_found() -> None:
    table, _ = found(day(world(CAR, POLE), 0), day(world(CAR), 1), settings=Settings(min_points=5))
    assert len(table) > 5 and within(points_of(table), POLE).all()


def test_what_moved_past_is_a_remnant_and_no_change() -> None:
    old_scans, T = drive(world(POLE), 32, step_m=0.8, seed=0)
    rng = np.random.default_rng(5)
    stamps = [scan.reference_ns for scan in old_scans]
    passing = [
        observe(
            world(POLE, CAR + np.array([-14.0 + 1.6 * k, 0, 0])), T[k], index=k, stamp_ns=stamps[k], rng=rng
        )
        for k in range(32)
    ]
    table, _ = found(Day(passing, T), day(world(POLE), 1))
    assert len(table) == 0 and table.remnants > 100


def test_a_map_that_extends_none_reads_nothing() -> None:
    class Untouched(Parts):  # type: ignore[type-arg]
        def __getitem__(self, i: object) -> object:
            raise AssertionError("nothing was to be read")

    old = day(world(), 0, count=1)
    poses: Parts[Poses] = Parts([((("session", "old"),), old.poses)])
    blank = Base.empty(frame="", georeference=None)
    table, files = changes(
        Settings(),
        Parts([((("session", "old"),), blank)]),
        poses,
        Untouched([]),
        Untouched([]),
        Untouched([]),
    )
    assert len(table) == 0 and not table.sessions and not files.contents


def test_ground_that_is_not_known_as_such_is_not_asked() -> None:
    one = day(world(CAR, POLE), 0, count=4)
    one.labels = [
        ScanLabels(np.full(len(scan), PointClass.STATIC, np.uint8), scan.reference_ns, scan.scan_index)
        for scan in one.scans
    ]
    asked = np.concatenate([standing_points(part.key, [part.product], 0.2, 0.3) for part in one.pieces()])
    every = np.concatenate([standing_points(part.key, [part.product], 0.2, 0.0) for part in one.pieces()])
    floor = GROUND_Z_M + 0.2
    assert (every[:, 2] < floor).sum() > 1000 and not (asked[:, 2] < floor).any()
    tall = every[:, 2] > GROUND_Z_M + 1.6
    assert 0.5 * tall.sum() < (asked[:, 2] > GROUND_Z_M + 1.6).sum() <= tall.sum()


def _says(point: Sequence[float], ray_to: Sequence[float], *, static: bool = True) -> tuple[int, int]:
    """(through, confirming) of one point, by one ray, both in the LiDAR frame."""
    image = new_image()
    x, y, z = (np.array([v], np.float32) for v in ray_to)
    fill(image, x, y, z, np.array([static]))
    through, confirming = np.zeros(1, np.int32), np.zeros(1, np.int32)
    judge(np.array([point], float), np.eye(4), image, Settings().limits(), through, confirming)
    return int(through[0]), int(confirming[0])


@pytest.mark.parametrize(
    ("point", "ray_to", "said"),
    [
        ((10, 0, 0), (10.69, 0, 0), (0, 0)),  # 0.5 m and 2 % of the range beyond is not enough
        ((10, 0, 0), (10.71, 0, 0), (1, 0)),
        ((10, 0, 0), (10.29, 0, 0), (0, 1)),
        ((10, 0, 0), (10.31, 0, 0), (0, 0)),
        ((10, 0, 0), (5, 0, 0), (0, 0)),
        ((10, 0, 0), (20, 0.38, 0), (1, 0)),  # passes 0.19 m beside it
        ((10, 0, 0), (20, 0.42, 0), (0, 0)),
        ((29.9, 0, 0), (50, 0, 0), (1, 0)),
        ((30.1, 0, 0), (50, 0, 0), (0, 0)),
        ((1.4, 0, 0), (50, 0, 0), (0, 0)),
    ],
)
def test_what_a_ray_says_at_the_edges(
    point: Sequence[float], ray_to: Sequence[float], said: tuple[int, int]
) -> None:
    assert _says(point, ray_to) == said


def test_a_moving_thing_at_the_place_confirms_nothing() -> None:
    assert _says((10, 0, 0), (10.1, 0, 0), static=False) == (0, 0)


def test_a_ray_that_ends_beside_the_point_leaves_it_open() -> None:
    image = new_image()
    rays = np.array([[20.0, 0.0, 0.0], [9.4, 0.1, 0.0]], np.float32)
    fill(image, *(np.ascontiguousarray(c) for c in rays.T), np.ones(2, bool))
    through, confirming = np.zeros(1, np.int32), np.zeros(1, np.int32)
    judge(np.array([[10.0, 0.0, 0.0]]), np.eye(4), image, Settings().limits(), through, confirming)
    assert through[0] == 0 and confirming[0] == 0


@pytest.mark.parametrize(("scans", "missed"), [(2, False), (3, True)])
def test_several_scans_must_see_through(scans: int, missed: bool) -> None:
    settings = Settings()
    assert settings.missed(np.array([scans], np.int32), np.array([0], np.int32))[0] == missed
    assert settings.stood(np.array([0], np.int32), np.array([scans], np.int32))[0] == missed


def test_one_confirmation_in_four_is_allowed() -> None:
    through, confirming = np.array([8, 8], np.int32), np.array([2, 3], np.int32)
    assert Settings().missed(through, confirming).tolist() == [True, False]


def test_objects_are_numbered_by_size_and_small_ones_left_out() -> None:
    line = np.column_stack((np.arange(20) * 0.5, np.zeros((20, 2))))
    points = np.concatenate((line[:5] + np.array([0, 50, 0]), line + np.array([0, 90, 0]), line[:15]))
    number = objects_of(points, 0.6, 12)
    assert number.tolist() == [-1] * 5 + [0] * 20 + [1] * 15
    assert objects_of(points, 0.4, 2).tolist() == [-1] * 40
    assert objects_of(np.empty((0, 3)), 0.6, 12).tolist() == []
