"""Neighbours of a scan: who they are at the ends of a chunk, how the LiDAR moved, and how much is held."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Iterator

import numpy as np
import pytest

from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise.window import Moment, View, moments
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.range_image import ImageSettings, range_image
from scanloom.stages.geometry.se3 import F8, se3_log
from tests.stages.denoise.test_stage import make_session
from tests.worlds import drive, relative, street

PERIOD_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000


def view(scan: DeskewedScan) -> View:
    every = np.ones(len(scan), np.bool_)
    classes = np.full(len(scan), PointClass.STATIC, np.uint8)
    return View(scan, classes, range_image(ImageSettings(), scan.x_m, scan.y_m, scan.z_m, every, every))


def sensors(poses: F8) -> tuple[Imu, Wheel]:
    """Exact gyro and wheels of an arc driven at constant rate, longer than the scans."""
    stamp_ns = START_NS - PERIOD_NS + 10_000_000 * np.arange(10 * len(poses) + 100)
    step = relative(poses[0], poses[1])
    yaw_rate = np.arctan2(step[1, 0], step[0, 0]) / 0.1
    n = len(stamp_ns)
    gyro, accel = np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1))
    gyro[:, 2] = yaw_rate
    return Imu(stamp_ns, gyro, accel), Wheel(stamp_ns, np.full(n, step[0, 3] / 0.1), np.full(n, np.nan))


def track_of(imu: Imu, wheel: Wheel) -> MotionTrack:
    return MotionTrack.build(imu, wheel, make_session())


SILENT = track_of(Imu.empty(), Wheel.empty())


def around(
    scans: list[DeskewedScan], track: MotionTrack, reach: int, *, register: bool = True
) -> list[Moment]:
    return [*moments((view(scan) for scan in scans), track, reach, register=register)]


@pytest.mark.parametrize("reach", [1, 2, 8])
def test_neighbours_are_the_scans_around_within_the_chunk(reach: int) -> None:
    scans, poses = drive(street(0), 5, rows=4, columns=64)
    found = around(scans, track_of(*sensors(poses)), reach)
    assert [moment.view.scan.scan_index for moment in found] == [0, 1, 2, 3, 4]
    for k, moment in enumerate(found):
        offsets = [each.offset for each in moment.neighbours]
        assert offsets == [j - k for j in range(5) if j != k and abs(j - k) <= reach]
        assert [each.view.scan.scan_index for each in moment.neighbours] == [k + o for o in offsets]
        assert len(moment.known()) == len(offsets)
        assert len(moment.known(-1, 1)) == (1 if k in (0, 4) else 2)


def test_motion_is_that_of_the_sensors() -> None:
    scans, poses = drive(street(0), 6, rows=4, columns=64, step_m=0.8)
    for k, moment in enumerate(around(scans, track_of(*sensors(poses)), 3)):
        for each in moment.neighbours:
            assert each.T_scan_neighbour is not None
            assert each.T_neighbour_scan is not None
            true = relative(poses[k], poses[k + each.offset])
            np.testing.assert_allclose(each.T_scan_neighbour, true, atol=1e-6)
            np.testing.assert_allclose(each.T_neighbour_scan @ true, np.eye(4), atol=1e-6)


def test_where_sensors_are_silent_the_scans_tell_the_motion() -> None:
    scans, poses = drive(street(0), 4, rows=32, columns=512, step_m=0.8)
    for k, moment in enumerate(around(scans, SILENT, 2)):
        for each in moment.neighbours:
            assert each.T_scan_neighbour is not None
            off = each.T_scan_neighbour - relative(poses[k], poses[k + each.offset])
            assert 0.0 < np.abs(off[:3, 3]).max() < 0.1
    without = around(scans, SILENT, 2, register=False)
    assert all(each.T_scan_neighbour is None for moment in without for each in moment.neighbours)
    assert not any(moment.known() for moment in without)


def test_motion_that_deskew_registered_is_not_sought_again() -> None:
    scans, poses = drive(street(0), 4, rows=4, columns=64, step_m=0.8)  # too few points to register
    assert not any(moment.known() for moment in around(scans, SILENT, 2))
    told = [
        dataclasses.replace(scan, next_twist=tuple(10.0 * se3_log(relative(here, there))))
        for scan, here, there in zip(scans, poses, poses[1:])
    ]
    told[1] = scans[1]
    found = around([*told, scans[3]], SILENT, 2)
    assert [[each.offset for each in moment.neighbours if each.T_scan_neighbour is not None] for moment in found] == [
        [1], [-1], [1], [-1],
    ]  # fmt: skip
    for k, moment in enumerate(found):
        for each in moment.neighbours:
            if each.T_scan_neighbour is not None:
                np.testing.assert_allclose(
                    each.T_scan_neighbour, relative(poses[k], poses[k + each.offset]), atol=1e-9
                )
    assert not any(moment.known() for moment in around(told, SILENT, 2, register=False))
    sensed = around(told, track_of(*sensors(poses)), 2)
    assert all(len(moment.known()) == len(moment.neighbours) for moment in sensed)


def test_a_pause_breaks_the_chain_of_motion() -> None:
    scans, poses = drive(street(0), 6, rows=4, columns=64, step_m=0.0)
    far = [scan if i < 3 else later(scan, 700_000_000) for i, scan in enumerate(scans)]
    found = around(far, track_of(*sensors(poses)), 8)
    assert [[each.offset for each in moment.neighbours if each.T_scan_neighbour is not None] for moment in found] == [
        [1, 2], [-1, 1], [-2, -1], [1, 2], [-1, 1], [-2, -1],
    ]  # fmt: skip


def later(scan: DeskewedScan, by_ns: int) -> DeskewedScan:
    return DeskewedScan(
        x_m=scan.x_m, y_m=scan.y_m, z_m=scan.z_m, intensity=scan.intensity,
        reference_ns=scan.reference_ns + by_ns, scan_index=scan.scan_index,
    )  # fmt: skip


def test_lonely_and_empty_scans_and_no_scans() -> None:
    assert around([], SILENT, 2) == []
    scans, _ = drive(street(0), 3, rows=4, columns=64)
    (alone,) = around(scans[:1], SILENT, 2)
    assert alone.neighbours == ()
    empty = [scan.take(slice(0, i)) for i, scan in enumerate(scans)]
    for moment in around(empty, SILENT, 2):
        assert moment.known() == []
        assert len(moment.neighbours) == 2


def test_only_a_few_scans_are_held() -> None:
    scan = drive(street(0), 1, rows=4, columns=64)[0][0]
    made: list[weakref.ref[View]] = []
    most = 0

    def views() -> Iterator[View]:
        for i in range(20):
            each = view(later(scan, i * PERIOD_NS))
            made.append(weakref.ref(each))
            yield each
            del each

    for moment in moments(views(), SILENT, 2, register=False):
        most = max(most, sum(each() is not None for each in made))
        del moment
    assert most == 5
