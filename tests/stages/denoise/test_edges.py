"""Scans and places at the edge of what denoise is made for: labels stay sensible, nothing breaks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise import Settings, denoise
from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from tests.stages.denoise.test_stage import Ramp, make_session
from tests.worlds import GROUND_Z_M, BoxWorld, observe, street

START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000
NO_CAR = Settings(ego_low_m=(-0.3, -0.3, -0.3), ego_high_m=(0.3, 0.3, 0.3))
LEFT_OUT = (
    PointClass.EGO,
    PointClass.OUTLIER,
    PointClass.OUT_OF_RANGE,
    PointClass.AIRBORNE,
    PointClass.DYNAMIC,
)

U1 = NDArray[np.uint8]


def labels_of(
    scans: list[DeskewedScan], beams: int = 32, T_base_lidar: F8 | None = None, settings: Settings = NO_CAR
) -> list[U1]:
    """Classes of scans taken in a row while standing."""
    timed = [
        dataclasses.replace(scan, reference_ns=START_NS + k * PERIOD_NS, scan_index=k)
        for k, scan in enumerate(scans)
    ]
    stamp_ns = START_NS - 5 * PERIOD_NS + 10_000_000 * np.arange(10 * len(scans) + 100)
    n = len(stamp_ns)
    imu = Imu(stamp_ns, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1)))
    wheel = Wheel(stamp_ns, np.zeros(n), np.full(n, np.nan))
    session = make_session(beams, T_base_lidar)
    found = [each.class_ for each in denoise(settings, Deskewed(timed), session, imu, wheel)]
    assert [len(classes) for classes in found] == [len(scan) for scan in scans]
    return found


def view(world: BoxWorld, T: F8 | None = None, count: int = 1, rows: int = 32) -> list[DeskewedScan]:
    at = np.eye(4) if T is None else T
    return [
        observe(world, at, rng=np.random.default_rng(k), rows=rows, columns=512, noise_m=0.015)
        for k in range(count)
    ]


def judged(scan: DeskewedScan, classes: U1, ground: NDArray[np.bool_]) -> tuple[float, float]:
    """Precision and recall of ground among the points in range."""
    used = np.linalg.norm(scan.points(), axis=1) > NO_CAR.min_range_m
    found = (classes == PointClass.GROUND) & used
    return float((found & ground).sum() / found.sum()), float((found & ground).sum() / (ground & used).sum())


def heights(scan: DeskewedScan, T: F8) -> F8:
    """Above the ground plane, m."""
    return scan.points().astype(float) @ T[2, :3] + T[2, 3] - GROUND_Z_M


@pytest.mark.parametrize("n", [0, 1, 2, 7])
def test_scans_of_a_few_points(n: int) -> None:
    scans = [scan.take(slice(0, n)) for scan in view(street(0), count=3)]
    for classes in labels_of(scans):
        assert not np.isin(classes, (PointClass.GROUND, PointClass.DYNAMIC)).any()
        assert (classes != PointClass.STATIC).all() or n > 2  # what stands alone is no scenery


def test_a_scan_without_a_number_between_sound_ones() -> None:
    scans = view(street(0), count=5)
    nothing = np.full(len(scans[2]), np.nan, np.float32)
    scans[2] = dataclasses.replace(scans[2], x_m=nothing, y_m=nothing, z_m=nothing, intensity=nothing)
    found = labels_of(scans)
    assert (found[2] == PointClass.OUT_OF_RANGE).all()
    for k in (0, 1, 3, 4):
        assert 0.25 < (found[k] == PointClass.GROUND).mean() < 0.7
        near = np.linalg.norm(scans[k].points(), axis=1) > NO_CAR.min_range_m
        assert np.isin(found[k][near], LEFT_OUT).mean() < 0.03


@pytest.mark.parametrize("value", [0.0, np.nan, 1.0])
def test_without_intensity_nothing_is_lost(value: float) -> None:
    """Sensors that tell no strength fill in zeros, or anything."""
    scans = [
        dataclasses.replace(scan, intensity=np.full(len(scan), value, np.float32))
        for scan in view(street(0), count=5)
    ]
    for scan, classes in zip(scans, labels_of(scans), strict=True):
        near = np.linalg.norm(scan.points(), axis=1) > NO_CAR.min_range_m
        assert np.isin(classes[near], LEFT_OUT).mean() < 0.03
        assert 0.25 < (classes == PointClass.GROUND).mean() < 0.7


def test_unknown_beams_and_points_in_any_order() -> None:
    """No stage reads rings; a sensor that gives its points in another order gets the same classes of nearly all."""
    (scan,) = view(street(0))
    mixed = np.random.default_rng(0).permutation(len(scan))
    classes, other = labels_of([scan], beams=0)[0], labels_of([scan.take(mixed)], beams=0)[0]
    assert (other == classes[mixed]).mean() > 0.995


@pytest.mark.parametrize("told", [True, False])
def test_upside_down(told: bool) -> None:
    """Ground is below when the mounting says so; when nothing does, it is the floor that the sensor sees above."""
    T = pose(so3_exp([np.pi, 0.0, 0.0]), [0.0, 0.0, 0.0])
    world = street(4)
    scan = observe(world, T, rng=np.random.default_rng(0), rows=32, columns=512)
    height = heights(scan, T)
    (classes,) = labels_of([scan], T_base_lidar=T if told else None)
    precision, recall = judged(scan, classes, np.abs(height) < 0.1)
    assert (scan.z_m[classes == PointClass.GROUND] > 0).all()
    assert 0.9 < precision <= 1.0
    assert 0.9 < recall <= 1.0


def hall(width_m: float, height_m: float, pillars: bool) -> BoxWorld:
    """A long room with a ceiling, walls, and pillars in two rows."""
    low, half = GROUND_Z_M, width_m / 2
    boxes = [
        [[-80.0, -half - 1.0, low + height_m], [80.0, half + 1.0, low + height_m + 1.0]],
        [[-80.0, half, low], [80.0, half + 1.0, low + height_m]],
        [[-80.0, -half - 1.0, low], [80.0, -half, low + height_m]],
    ]
    if pillars:
        for x in np.arange(-37.0, 40.0, 7.5):
            for y in (-4.0, 4.0):
                boxes.append([[x - 0.2, y - 0.2, low], [x + 0.2, y + 0.2, low + height_m]])
    return BoxWorld(np.array(boxes))


@pytest.mark.parametrize(
    ("width_m", "height_m", "pillars"), [(9.0, 5.0, False), (30.0, 2.2, True), (16.0, 2.6, True)]
)
def test_ceilings_of_tunnels_and_car_parks_are_not_ground(
    width_m: float, height_m: float, pillars: bool
) -> None:
    scans = view(hall(width_m, height_m, pillars), count=3)
    for scan, classes in zip(scans, labels_of(scans), strict=True):
        height = heights(scan, np.eye(4))
        precision, recall = judged(scan, classes, np.abs(height) < 0.08)
        assert 0.95 < precision <= 1.0
        assert 0.95 < recall <= 1.0
        assert not (classes[height > 1.0] == PointClass.GROUND).any()
        near = np.linalg.norm(scan.points(), axis=1) > NO_CAR.min_range_m
        assert np.isin(classes[near], LEFT_OUT).mean() < 0.03


@pytest.mark.parametrize("above_m", [0.4, 1.0, 3.0])
def test_robots_and_trucks(above_m: float) -> None:
    """A LiDAR anywhere from 0.4 m to 3 m above the ground, which nobody tells."""
    T = pose(np.eye(3), [0.0, 0.0, GROUND_Z_M + above_m])
    (scan,) = view(street(1), T, rows=64)
    (classes,) = labels_of([scan], beams=64)
    precision, recall = judged(scan, classes, np.abs(heights(scan, T)) < 0.1)
    assert 0.95 < precision <= 1.0
    assert 0.9 < recall <= 1.0


@pytest.mark.parametrize("grade", [0.15, -0.15])
def test_ramps_of_car_parks(grade: float) -> None:
    walls = np.array([[[-40.0, side * 5.5 - 1.5, -8.0], [60.0, side * 5.5 + 1.5, 14.0]] for side in (-1, 1)])
    world = Ramp(walls, grade)
    scan = observe(world, np.eye(4), rng=np.random.default_rng(2), rows=64, columns=512, noise_m=0.015)
    (classes,) = labels_of([scan], beams=64)
    points = scan.points().astype(float)
    height = points[:, 2] - world.height(points[:, 0])
    road = (np.abs(points[:, 1]) < 3.9) & (np.abs(height) < 0.15) & (np.hypot(*points[:, :2].T) < 35.0)
    ground = classes == PointClass.GROUND
    assert 0.93 < ground[road].mean() <= 1.0
    assert ground[height > 0.5].mean() < 0.01
