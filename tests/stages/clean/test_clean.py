"""Whole cleaning on streets with exact truth: what moves goes, what stands stays, what changed is called so."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import PointClass
from tests.stages.clean.worlds import Drive, car, cleared_of, drive_past, finals, rays_of, relabelled, wall

WALLS = (wall(-20.0, 8.0, 100.0), wall(-20.0, -15.0, 100.0))
PARKED = car(22.0, 5.0)
POLE = np.array([[15.0, -4.1, -1.8], [15.15, -3.95, 3.0]])


def shares(drive: Drive, classes: list[np.ndarray], box_at: object, class_: PointClass) -> tuple[float, int]:
    """Share of the points in a box (that may move) that have the class, and their number."""
    right = total = 0
    for n, found in enumerate(classes):
        box = box_at(0.1 * n) if callable(box_at) else box_at
        rows = drive.within(n, np.asarray(box))
        right += int((found[rows] == class_).sum())
        total += int(rows.sum())
    return right / max(total, 1), total


@pytest.mark.parametrize("pose_noise_m", [0.0, 0.03])
def test_an_oncoming_car_goes_and_everything_else_stays(pose_noise_m: float) -> None:
    def oncoming(t: float) -> np.ndarray:
        return car(45.0 - 10.0 * t, 2.0)

    drive = drive_past([*WALLS, PARKED, POLE], [oncoming], pose_noise_m=pose_noise_m)
    classes = finals({"a": drive})["a"]
    gone, points = shares(drive, classes, oncoming, PointClass.DYNAMIC)
    assert points > 2000
    assert gone > 0.98
    for thing in (*WALLS, PARKED, POLE):
        stays, points = shares(drive, classes, thing, PointClass.STATIC)
        assert points > 100
        assert stays > 0.99
    for before, after in zip(drive.labels, classes):
        ground = before.class_ == PointClass.GROUND
        assert (after[ground] == PointClass.GROUND).all()


def test_a_car_that_waited_and_left_goes_wholly_and_one_that_stays_does_not() -> None:
    def waiting(t: float) -> np.ndarray:
        return car(20.0 - 9.0 * max(0.0, t - 4.0), 2.0)

    drive = drive_past([*WALLS, PARKED], [waiting], count=80, step_m=0.3)
    classes = finals({"a": drive})["a"]
    gone, points = shares(drive, classes, waiting, PointClass.DYNAMIC)
    assert points > 5000
    assert gone > 0.97
    stays, points = shares(drive, classes, PARKED, PointClass.STATIC)
    assert points > 5000
    assert stays > 0.99


def test_a_car_that_came_and_parked_stands() -> None:
    def parking(t: float) -> np.ndarray:
        return car(20.0 - 9.0 * max(0.0, 2.0 - t), 2.0)

    drive = drive_past([*WALLS], [parking], count=150, step_m=0.05)
    classes = finals({"a": drive})["a"]
    rows = range(30, 150)
    stays = [(classes[n][drive.within(n, parking(9.0))] == PointClass.STATIC).mean() for n in rows]
    assert np.mean(stays) > 0.9
    gone = [(classes[n][drive.within(n, parking(0.1 * n))] == PointClass.DYNAMIC).mean() for n in range(15)]
    assert np.mean(gone) > 0.9


def test_what_left_between_two_sessions_has_changed_and_did_not_move() -> None:
    left = car(20.0, 2.2)
    first = drive_past([*WALLS, PARKED, left], [], seed=1)
    second = drive_past([*WALLS, PARKED], [], seed=2, pose_noise_m=0.03, day=1)
    classes = finals({"first": first, "second": second})
    changed, points = shares(first, classes["first"], left, PointClass.CHANGED)
    assert points > 2000
    assert changed > 0.95
    assert shares(first, classes["first"], left, PointClass.DYNAMIC)[0] < 0.002
    for name, drive in (("first", first), ("second", second)):
        assert shares(drive, classes[name], PARKED, PointClass.STATIC)[0] > 0.98
        assert sum((c == PointClass.DYNAMIC).sum() for c in classes[name]) < 0.0002 * sum(
            map(len, classes[name])
        )


def test_what_came_between_two_sessions_stays() -> None:
    came = car(20.0, 2.2)
    first = drive_past([*WALLS], [], seed=1)
    second = drive_past([*WALLS, came], [], seed=2, day=1)
    classes = finals({"first": first, "second": second})["second"]
    assert shares(second, classes, came, PointClass.CHANGED)[0] == 0.0
    assert shares(second, classes, came, PointClass.STATIC)[0] > 0.99


def test_a_world_at_rest_loses_nothing() -> None:
    drive = drive_past([*WALLS, PARKED, POLE], [], pose_noise_m=0.02)
    classes = finals({"a": drive})["a"]
    lost = sum(int((c == PointClass.DYNAMIC).sum()) for c in classes)
    assert lost <= 0.001 * sum(map(len, classes))


def test_cut_into_chunks_otherwise_the_verdicts_hardly_differ() -> None:
    drive = drive_past([*WALLS, PARKED], [lambda t: car(45.0 - 10.0 * t, 2.0)])
    whole = cleared_of(rays_of({"a": drive}, chunk=60))["a"]
    halves = cleared_of(rays_of({"a": drive}, chunk=30))["a"]
    for one, two in zip(whole, halves, strict=True):
        if not len(one):
            continue
        same = np.isin(one.brick, two.brick)
        assert same.mean() > 0.95
        both = np.intersect1d(one.brick, two.brick)
        a, b = (t.verdict[np.searchsorted(t.brick, both)] for t in (one, two))
        assert (a != b).mean() < 0.02


def test_the_same_bytes_again() -> None:
    drive = drive_past([*WALLS, PARKED], [lambda t: car(45.0 - 10.0 * t, 2.0)], count=20)
    one, two = (cleared_of(rays_of({"a": drive}))["a"] for _ in range(2))
    for a, b in zip(one, two, strict=True):
        assert a.brick.tobytes() == b.brick.tobytes()
        assert a.verdict.tobytes() == b.verdict.tobytes()


def test_scans_without_pose_keep_their_classes_and_are_counted() -> None:
    drive = drive_past([*WALLS], [], count=6)
    cleared = cleared_of(rays_of({"a": drive}))["a"]
    drive.T[3] = np.nan
    labels, counts = relabelled(drive, cleared)
    assert (labels[3].class_ == drive.labels[3].class_).all()
    assert counts.scan_index.tolist() == list(range(6))
    assert (counts.points.sum(axis=1) == [len(s) for s in drive.scans]).all()
    assert (counts.before.sum(axis=1) == counts.points.sum(axis=1)).all()


def test_without_verdicts_only_the_tracker_speaks() -> None:
    drive = drive_past([*WALLS, PARKED], [], count=3)
    box = np.eye(4)
    box[:3, 3] = [24.15, 5.9, -1.8]
    T = np.linalg.inv(drive.T[1]) @ box
    tracks = ObjectTracks(
        scan_index=np.array([1]), stamp_ns=np.array([0]), track=np.zeros(1, np.int32), T_odom_object=box[None],
        T_lidar_object=T[None], length_m=np.array([4.3]), width_m=np.array([1.8]), height_m=np.array([1.6]),
        speed_m_s=np.array([3.0]), class_=np.ones(1, np.uint8), dynamic=np.array([True]), score=np.ones(1),
    )  # fmt: skip
    moved = drive.within(1, PARKED)
    drive.labels[1].class_[np.flatnonzero(moved)[::3]] = PointClass.AIRBORNE  # dark paint, taken for dust
    labels, _ = relabelled(drive, Parts([]), tracks)
    assert moved.sum() > 10
    assert (labels[1].class_[moved] == PointClass.DYNAMIC).all()
    assert not (labels[0].class_ == PointClass.DYNAMIC).any()
    still, _ = relabelled(drive, Parts([]), tracks.take(~tracks.dynamic))
    assert not (still[1].class_ == PointClass.DYNAMIC).any()


def test_empty_scans_and_scans_of_one_point_pass() -> None:
    drive = drive_past([*WALLS], [], count=3)
    drive.scans[1] = drive.scans[1].take(slice(0, 1))
    drive.labels[1] = drive.labels[1].take(slice(0, 1))
    drive.scans[2] = drive.scans[2].take(slice(0, 0))
    drive.labels[2] = drive.labels[2].take(slice(0, 0))
    classes = finals({"a": drive})["a"]
    assert [len(c) for c in classes] == [len(s) for s in drive.scans]


def test_no_scan_has_a_pose() -> None:
    drive = drive_past([*WALLS], [], count=2)
    drive.T[:] = np.nan
    assert rays_of({"a": drive}) == {}
    labels, _ = relabelled(drive, Parts([]))
    assert all((a.class_ == b.class_).all() for a, b in zip(labels, drive.labels))
