"""Descriptors: what they must notice and what they must not."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.stages.geometry.se3 import pose, so3_exp
from scanloom.stages.loops.candidates import descriptor_distance
from scanloom.stages.loops.places import Settings, places, scan_context
from tests.stages.loops.worlds import block, chunks, labels_of, odometry_of, polyline, scans_of
from tests.worlds import observe


def scan_at(x: float, y: float, yaw_deg: float) -> tuple[DeskewedScan, ScanLabels]:
    T = pose(so3_exp([0, 0, np.radians(yaw_deg)]), [x, y, 0])
    scan = observe(block(1), T, rows=24, columns=600)
    return scan, labels_of([scan], T[None])[0]


def of_points(points: list[list[float]], classes: list[int]) -> np.ndarray:
    p = np.array(points, np.float32)
    n = len(p)
    scan = DeskewedScan(
        x_m=p[:, 0].copy(), y_m=p[:, 1].copy(), z_m=p[:, 2].copy(),
        intensity=np.zeros(n, np.float32), reference_ns=0,
        scan_index=0,
    )  # fmt: skip
    return scan_context(
        scan, ScanLabels(class_=np.array(classes, np.uint8), reference_ns=0, scan_index=0), Settings()
    )


def test_bins_hold_the_highest_point() -> None:
    d = of_points([[5, 0.1, 1], [5, 0.1, 3], [79.9, -0.1, 0], [81, 0, 9], [0.1, -5, -9]], [2] * 5)
    assert d[1, 0] == pytest.approx(5.5)
    assert d[19, 59] == pytest.approx(2.5)
    assert np.count_nonzero(d) == 2


def test_classes_that_do_not_belong_to_the_place_are_left_out() -> None:
    for left_out in (
        PointClass.DYNAMIC,
        PointClass.AIRBORNE,
        PointClass.EGO,
        PointClass.OUTLIER,
        PointClass.OUT_OF_RANGE,
    ):
        assert not of_points([[5, 0, 1]], [left_out]).any()
    for kept in (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC):
        assert of_points([[5, 0, 1]], [kept]).any()


@pytest.mark.parametrize("yaw_deg", [0.0, 42.0, 90.0, 180.0, -120.0])
def test_the_same_place_from_another_heading(yaw_deg: float) -> None:
    a = scan_context(*scan_at(-30, 0, -90), Settings())
    b = scan_context(*scan_at(-29.5, 0.5, -90 + yaw_deg), Settings())
    far = scan_context(*scan_at(-3, 30, 0), Settings())
    distance, heading = descriptor_distance(a, b)
    assert 0.0 < distance < 0.2
    assert abs(np.angle(np.exp(1j * (heading - np.radians(yaw_deg))))) < np.radians(7)
    assert descriptor_distance(a, far)[0] > distance + 0.05


def test_nearly_empty_scans_are_not_alike() -> None:
    d = of_points([[5, 0, 1], [0, 5, 1]], [2, 2])
    assert descriptor_distance(d, d)[0] == 1.0


def test_only_keyframes_are_described_and_read_once() -> None:
    T = polyline([(-30, 20), (-30, 8)])
    scans = scans_of(block(1), T)
    labels = labels_of(scans, T)
    odometry = odometry_of(T, scans)
    odometry.keyframe[::3] = False
    result = places(Settings(), chunks(Deskewed, scans, 5), chunks(Labels, labels, 5), odometry)
    assert result.scan_index.tolist() == [k for k in range(len(T)) if k % 3]
    np.testing.assert_array_equal(result.stamp_ns, odometry.stamp_ns[odometry.keyframe])
    assert result.max_radius_m == 80.0


def test_labels_of_another_scan_are_an_error() -> None:
    T = polyline([(-30, 20), (-30, 18)])
    scans = scans_of(block(1), T)
    labels = labels_of(scans, T)[::-1]
    with pytest.raises(StageError, match="do not fit"):
        places(Settings(), chunks(Deskewed, scans), chunks(Labels, labels), odometry_of(T, scans))


def test_no_keyframes_no_places() -> None:
    T = polyline([(-30, 20), (-30, 18)])
    scans = scans_of(block(1), T)
    odometry = odometry_of(T, scans).take(slice(0, 0))
    assert len(places(Settings(), Parts([]), Parts([]), odometry)) == 0
