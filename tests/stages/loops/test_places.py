"""Descriptors: what they must notice and what they must not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.stages.geometry.se3 import pose, so3_exp
from scanloom.stages.loops.places import Description, Settings, describe, places
from scanloom.stages.loops.reading import joined
from scanloom.stages.loops.scan_context import descriptor_distance
from tests.stages.loops.worlds import block, chunks, described, labels_of, odometry_of, polyline, scans_of
from tests.worlds import observe


def scan_at(x: float, y: float, yaw_deg: float) -> tuple[DeskewedScan, ScanLabels]:
    T = pose(so3_exp([0, 0, np.radians(yaw_deg)]), [x, y, 0])
    scan = observe(block(1), T, rows=24, columns=600)
    return scan, labels_of([scan], T[None])[0]


def of_points(points: list[list[float]], classes: list[int]) -> Description:
    p = np.array(points, np.float32).reshape(-1, 3)
    n = len(p)
    scan = DeskewedScan(
        x_m=p[:, 0].copy(), y_m=p[:, 1].copy(), z_m=p[:, 2].copy(),
        intensity=np.zeros(n, np.float32), reference_ns=0,
        scan_index=0,
    )  # fmt: skip
    label = ScanLabels(class_=np.array(classes, np.uint8), reference_ns=0, scan_index=0)
    return describe(Settings(), scan, label)


def test_bins_hold_the_highest_point() -> None:
    points = [[5, 0.1, 1], [5, 0.1, 3], [79.9, -0.1, 0], [81, 0, 9], [0.1, -5, -9]]
    d = of_points(points, [2] * 5).descriptor
    assert d[1, 0] == pytest.approx(5.5)
    assert d[19, 59] == pytest.approx(2.5)
    assert np.count_nonzero(d) == 2


def test_from_beside_the_middle_of_the_rings_is_a_lane_away() -> None:
    d = of_points([[30.0, 3.5, 1.0], [6.5, -10.0, 2.0]], [2, 2])
    left, right = d.beside
    assert left[7, 0] == pytest.approx(3.5)
    assert right[7, 0] == 0.0
    assert right[2, 52] == pytest.approx(4.5)


def test_classes_that_do_not_belong_to_the_place_are_left_out() -> None:
    for left_out in (
        PointClass.DYNAMIC,
        PointClass.AIRBORNE,
        PointClass.EGO,
        PointClass.OUTLIER,
        PointClass.OUT_OF_RANGE,
    ):
        assert not of_points([[5, 0, 1]], [left_out]).descriptor.any()
    for kept in (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC):
        assert of_points([[5, 0, 1]], [kept]).descriptor.any()


@pytest.mark.parametrize("yaw_deg", [0.0, 42.0, 90.0, 180.0, -120.0])
def test_the_same_place_from_another_heading(yaw_deg: float) -> None:
    a = describe(Settings(), *scan_at(-30, 0, -90))
    b = describe(Settings(), *scan_at(-29.5, 0.5, -90 + yaw_deg))
    far = describe(Settings(), *scan_at(-3, 30, 0))
    for name in ("descriptor", "segment_descriptor"):
        distance, heading = descriptor_distance(getattr(a, name), getattr(b, name))
        assert 0.0 < distance < 0.2
        assert abs(np.angle(np.exp(1j * (heading - np.radians(yaw_deg))))) < np.radians(7)
        assert descriptor_distance(getattr(a, name), getattr(far, name))[0] > distance + 0.05


def test_the_way_back_on_the_other_lane_is_known_from_beside() -> None:
    there = describe(Settings(), *scan_at(-30, 0, -90))
    back = describe(Settings(), *scan_at(-26.5, 0, 90))
    straight = descriptor_distance(there.descriptor, back.descriptor)[0]
    beside, heading = descriptor_distance(there.descriptor, back.beside[0])
    assert beside < straight - 0.03
    assert abs(abs(heading) - np.pi) < np.radians(7)
    assert descriptor_distance(there.descriptor, back.beside[1])[0] > beside + 0.03


def test_segments_know_nothing_of_the_ground_nor_of_single_points() -> None:
    scan, label = scan_at(-30, 0, -90)
    flat = dataclasses.replace(label, class_=np.full(len(scan), PointClass.GROUND, np.uint8))
    d = describe(Settings(), scan, flat)
    assert d.descriptor.any()
    assert not d.segment_descriptor.any()
    rng = np.random.default_rng(0)
    leaves = rng.uniform(-30, 30, (400, 3))
    assert not of_points(leaves.tolist(), [2] * 400).segment_descriptor.any()


def test_a_sensor_that_hangs_upside_down_sees_the_same_place() -> None:
    scan, label = scan_at(-30, 0, -90)
    turned = dataclasses.replace(scan, y_m=-scan.y_m, z_m=-scan.z_m)
    a, b = describe(Settings(), scan, label), describe(Settings(), turned, label)
    np.testing.assert_array_equal(a.descriptor, b.descriptor)
    np.testing.assert_array_equal(a.segment_descriptor, b.segment_descriptor)


@pytest.mark.parametrize("intensity", [0.0, np.nan, np.inf])
def test_without_intensities_the_angle_alone_decides(intensity: float) -> None:
    scan, label = scan_at(-30, 0, -90)
    blank = dataclasses.replace(scan, intensity=np.full(len(scan), intensity, np.float32))
    d = describe(Settings(), blank, label)
    assert np.isfinite(d.segment_descriptor).all()
    assert (d.segment_descriptor > 0).sum() > 50


@pytest.mark.parametrize("count", [0, 1])
def test_a_scan_of_hardly_any_points(count: int) -> None:
    d = of_points([[5.0, 0.0, 1.0]] * count, [2] * count)
    assert np.count_nonzero(d.descriptor) == count
    assert not d.segment_descriptor.any()


def test_points_that_are_no_numbers_are_nowhere() -> None:
    d = of_points([[np.nan, 0, 1], [np.inf, 0, 1], [0, 0, 0]], [2, 2, 2])
    assert np.isfinite(d.descriptor).all()
    assert np.count_nonzero(d.descriptor) == 1


def test_nearly_empty_scans_are_not_alike() -> None:
    d = of_points([[5, 0, 1], [0, 5, 1]], [2, 2]).descriptor
    assert descriptor_distance(d, d)[0] == 1.0


def test_only_keyframes_are_described_chunk_by_chunk() -> None:
    T = polyline([(-30, 20), (-30, 8)])
    scans = scans_of(block(1), T)
    labels = labels_of(scans, T)
    odometry = odometry_of(T, scans)
    odometry.keyframe[::3] = False
    parts = described(Settings(), chunks(Deskewed, scans, 5), chunks(Labels, labels, 5), odometry)
    assert len(parts) == 3
    whole = described(Settings(), chunks(Deskewed, scans, 50), chunks(Labels, labels, 50), odometry)[0]
    result = joined(list(parts))
    assert result.scan_index.tolist() == [k for k in range(len(T)) if k % 3]
    np.testing.assert_array_equal(result.stamp_ns, odometry.stamp_ns[odometry.keyframe])
    np.testing.assert_array_equal(result.segment_beside, whole.segment_beside)
    assert (result.max_radius_m, result.lane_m) == (80.0, 3.5)


def test_labels_of_another_scan_are_an_error() -> None:
    T = polyline([(-30, 20), (-30, 18)])
    scans = scans_of(block(1), T)
    labels = labels_of(scans, T)[::-1]
    with pytest.raises(StageError, match="do not fit"):
        places(Settings(), Deskewed(scans), Labels(labels), odometry_of(T, scans))


def test_no_keyframes_no_places() -> None:
    T = polyline([(-30, 20), (-30, 18)])
    scans = scans_of(block(1), T)
    odometry = odometry_of(T, scans).take(slice(0, 0))
    assert len(places(Settings(), Deskewed(scans), Labels(labels_of(scans, T)), odometry)) == 0
    assert len(described(Settings(), Parts([]), Parts([]), odometry)) == 0
