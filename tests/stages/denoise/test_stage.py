"""Labels against exact truth: which returns come from the ground, from houses and cars, from nothing at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass
from scanloom.schemas.session import Extrinsic, Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise import Settings, denoise
from scanloom.stages.denoise.stage import REACH
from scanloom.stages.geometry.se3 import F8, pose, so3_exp, transform
from scanloom.stages.geometry.spacing import azimuth_step_rad
from tests.worlds import GROUND_Z_M, BoxWorld, observe, street

SETTINGS = Settings()
SILENT = Imu.empty(), Wheel.empty()
LEFT_OUT = (PointClass.EGO, PointClass.OUTLIER, PointClass.OUT_OF_RANGE)


def make_session(beams: int = 16, T_base_lidar: F8 | None = None) -> Session:
    mount = np.eye(4) if T_base_lidar is None else T_base_lidar
    lidar = Extrinsic(sensor="lidar", T_base_sensor=tuple(map(tuple, mount.tolist())), source="test")
    return Session(
        name="test", format="mcap", start_ns=0, end_ns=10**9, scan_count=1, point_count=1, scan_rate_hz=10.0,
        beams=beams, point_time="per point", topics=(), extrinsics=(lidar,), problems=(), complete=True,
    )  # fmt: skip


def labels_of(scan: DeskewedScan, session: Session, settings: Settings = SETTINGS) -> NDArray[np.uint8]:
    (labels,) = iter(denoise(settings, Deskewed([scan]), session, *SILENT))
    assert len(labels) == len(scan)
    assert (labels.reference_ns, labels.scan_index) == (scan.reference_ns, scan.scan_index)
    return labels.class_


def scores(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> tuple[float, float]:
    """Precision and recall."""
    both = (found & truth).sum()
    return both / found.sum(), both / truth.sum()


def with_points(scan: DeskewedScan, points: F8) -> DeskewedScan:
    """The scan with points (k, 3) appended."""
    more = scan.take(np.zeros(len(points), int))
    x, y, z = points.astype(np.float32).T
    return DeskewedScan.concatenate(
        [scan, dataclasses.replace(more, x_m=x.copy(), y_m=y.copy(), z_m=z.copy())]
    )


@dataclasses.dataclass(frozen=True)
class Ramp(BoxWorld):
    """Level ground up to x = 12 m, then rising or falling by `grade`; boxes stand on it at y = +-9 m."""

    grade: float = 0.15

    def height(self, x: F8) -> F8:
        return GROUND_Z_M + self.grade * np.maximum(x - 12.0, 0.0)

    def ranges(self, origin: F8, direction: F8, far_m: float = 100.0) -> F8:
        level = super().ranges(origin, direction, far_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (GROUND_Z_M - 12.0 * self.grade + self.grade * origin[:, 0] - origin[:, 2]) / (
                direction[:, 2] - self.grade * direction[:, 0]
            )
            x = origin[:, 0] + t * direction[:, 0]
            ramp = np.where((t > 0) & (x > 12.0), t, np.inf)
            on_plane = np.abs(origin[:, 2] + level * direction[:, 2] - GROUND_Z_M) < 1e-6
            level = np.where(on_plane & (origin[:, 0] + level * direction[:, 0] > 12.0), np.inf, level)
        best = np.minimum(ramp, level)
        return np.where(best < far_m, best, np.inf)


@pytest.mark.parametrize(("rows", "columns"), [(16, 512), (32, 512), (64, 1024)])
@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [33.0, 1.0, 0.0]])
def test_ground_of_a_street_and_nothing_else(rows: int, columns: int, place: list[float]) -> None:
    T = pose(so3_exp([0.0, 0.0, 0.3]), place)
    scan = observe(street(0), T, rng=np.random.default_rng(1), rows=rows, columns=columns)
    found = labels_of(scan, make_session(rows)) == PointClass.GROUND
    height = transform(T, scan.points())[:, 2] - GROUND_Z_M
    precision, recall = scores(found, np.abs(height) < 0.1)
    assert 0.95 < precision < 1.0  # the lowest centimetres of walls are within the noise
    assert 0.95 < recall <= 1.0
    assert found[height > 0.3].mean() < 1e-3
    assert 0.25 < found.mean() < 0.6


@pytest.mark.parametrize("grade", [0.15, -0.12])
@pytest.mark.parametrize("rows", [16, 64])
def test_ground_follows_a_ramp(grade: float, rows: int) -> None:
    boxes = np.array([[[-40.0, side * 9.5 - 1.5, -8.0], [60.0, side * 9.5 + 1.5, 12.0]] for side in (-1, 1)])
    world = Ramp(boxes, grade)
    scan = observe(world, np.eye(4), rng=np.random.default_rng(2), rows=rows, columns=512)
    points = scan.points().astype(float)
    found = labels_of(scan, make_session(rows)) == PointClass.GROUND
    on_road = np.abs(points[:, 1]) < 7.9
    height = points[:, 2] - world.height(points[:, 0])
    clear = on_road | (height > 0.2)  # the foot of a wall may count as either
    precision, recall = scores(found[clear], (on_road & (np.abs(height) < 0.15))[clear])
    assert 0.98 < precision <= 1.0
    assert 0.95 < recall <= 1.0
    beyond = on_road & (np.abs(height) < 0.15) & (points[:, 0] > 13.0) & (points[:, 0] < 40.0)
    assert beyond.sum() > 40
    assert found[beyond].mean() > 0.88


@pytest.mark.parametrize(
    ("height_m", "roll", "pitch"), [(0.6, 0.0, 0.0), (1.2, 0.05, 0.0), (2.6, 0.0, -0.05)]
)
def test_height_and_tilt_of_the_sensor_are_found(height_m: float, roll: float, pitch: float) -> None:
    T = pose(so3_exp([roll, pitch, 0.0]), [0.0, 0.0, GROUND_Z_M + height_m])
    scan = observe(street(0), T, rng=np.random.default_rng(3), rows=32, columns=512)
    found = labels_of(scan, make_session(32)) == PointClass.GROUND
    truth = np.abs(transform(T, scan.points())[:, 2] - GROUND_Z_M) < 0.1
    used = np.linalg.norm(scan.points(), axis=1) > SETTINGS.min_range_m
    precision, recall = scores(found[used], truth[used])
    assert precision > 0.95
    assert recall > 0.95


def test_tilted_mounting_is_taken_from_the_extrinsics() -> None:
    mount = pose(so3_exp([0.0, 0.35, 0.0]), [0.0, 0.0, 0.0])
    scan = observe(street(0), mount, rng=np.random.default_rng(4), rows=32, columns=512)
    truth = np.abs(transform(mount, scan.points())[:, 2] - GROUND_Z_M) < 0.1
    used = np.linalg.norm(scan.points(), axis=1) > SETTINGS.min_range_m
    found = labels_of(scan, make_session(32, mount)) == PointClass.GROUND
    precision, recall = scores(found[used], truth[used])
    assert precision > 0.95
    assert recall > 0.95


def test_without_ground_nothing_is_ground() -> None:
    rng = np.random.default_rng(0)
    scan = observe(street(0), np.eye(4), rng=rng)
    above = scan.take(scan.z_m > 0.0)
    assert not (labels_of(above, make_session()) == PointClass.GROUND).any()


@pytest.mark.parametrize(("rows", "columns"), [(16, 512), (64, 1024)])
def test_a_clean_street_loses_little(rows: int, columns: int) -> None:
    scan = observe(street(5), np.eye(4), rng=np.random.default_rng(1), rows=rows, columns=columns)
    lost = np.isin(labels_of(scan, make_session(rows)), LEFT_OUT).mean()
    assert lost < 0.03


@pytest.mark.parametrize("rows", [16, 64])
def test_lonely_points_are_outliers(rows: int) -> None:
    rng = np.random.default_rng(7)
    scan = observe(street(0), np.eye(4), rng=rng, rows=rows, columns=512)
    angle, away = rng.uniform(0, 2 * np.pi, 200), rng.uniform(5, 40, 200)
    specks = np.column_stack((away * np.cos(angle), away * np.sin(angle), rng.uniform(10, 25, 200)))
    classes = labels_of(with_points(scan, specks), make_session(rows))
    speck = np.arange(len(classes)) >= len(scan)
    assert 0.9 < (classes[speck] == PointClass.OUTLIER).mean() <= 1.0
    assert (classes[~speck] == PointClass.OUTLIER).mean() < 0.03
    kept = labels_of(with_points(scan, specks), make_session(rows), Settings(outlier_neighbours=0))
    assert not (kept == PointClass.OUTLIER).any()


def test_range_vehicle_and_broken_points() -> None:
    scan = observe(street(0), np.eye(4), rng=np.random.default_rng(1))
    T_base_lidar = pose(np.eye(3), [1.0, 0.0, 1.9])
    odd = np.array(
        [
            [np.nan, 1, 1],
            [0, 0, 0],
            [0, 0.5, 1.0],
            [99, 99, 0],
            [np.inf, 0, 0],
            [-2.0, 0.3, -0.4],
            [0.2, 0.2, -0.9],
        ]
    )
    classes = labels_of(with_points(scan, odd), make_session(16, T_base_lidar))[-len(odd) :]
    far, ego = PointClass.OUT_OF_RANGE, PointClass.EGO
    bare = labels_of(with_points(scan, odd), make_session(16))[-len(odd) :]  # where the LiDAR is the base
    assert not (bare == ego).any()
    assert classes.tolist() == [far, far, far, far, far, ego, ego]


def test_empty_and_tiny_scans_pass() -> None:
    scan = observe(street(0), np.eye(4), rng=np.random.default_rng(1))
    assert len(labels_of(scan.take(slice(0, 0)), make_session())) == 0
    assert len(labels_of(scan.take(slice(0, 3)), make_session(0))) == 3
    assert [*iter(denoise(SETTINGS, Deskewed([]), make_session(), *SILENT))] == []


def test_labels_stream_and_the_same_input_gives_the_same_bytes() -> None:
    scans = [observe(street(0), np.eye(4), index=i, rng=np.random.default_rng(i)) for i in range(12)]
    before = [scan.points().tobytes() for scan in scans]
    taken = 0

    def feed() -> Iterator[DeskewedScan]:
        nonlocal taken
        for scan in scans:
            taken += 1
            yield scan

    stream = iter(denoise(SETTINGS, Deskewed(feed()), make_session(), *SILENT))
    first = [next(stream)]
    assert taken == REACH + 1
    first += [*stream]
    again = [*iter(denoise(SETTINGS, Deskewed(scans), make_session(), *SILENT))]
    assert [labels.class_.tobytes() for labels in first] == [a.class_.tobytes() for a in again]
    assert before == [scan.points().tobytes() for scan in scans]


def test_azimuth_step_is_near_the_truth_and_bounded() -> None:
    assert azimuth_step_rad(123_000, 64) == pytest.approx(np.radians(0.187), rel=0.01)
    assert azimuth_step_rad(10, 16) == 0.02
    assert azimuth_step_rad(10**7, 16) == 0.001
