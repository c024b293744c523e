"""Snow and dust in an analytic street: found with and without intensities, and nothing solid taken for them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise import Settings, denoise
from scanloom.stages.denoise.airborne import CLEAR_AIR, LEAST_SHARE, MOST_SHIFT, airborne, shifts
from scanloom.stages.denoise.stage import view
from scanloom.stages.denoise.weights import SHARES
from scanloom.stages.denoise.window import Moment
from tests.stages.denoise.test_stage import SILENT, make_session
from tests.stages.denoise.test_window import sensors
from tests.worlds import GROUND_Z_M, BoxWorld, drive, street

AIRBORNE = PointClass.AIRBORNE
ROWS = 32
B1 = NDArray[np.bool_]


def drifting(
    seed: int, share: float, world: BoxWorld | None = None, far_m: float = 20.0
) -> tuple[list[DeskewedScan], list[B1], tuple[Imu, Wheel]]:
    """Scans of a street with flakes on a share of the rays, which of the points they are, and exact sensors."""
    rng = np.random.default_rng(seed)
    clear, poses = drive(world or street(seed), 11, rows=ROWS, columns=720, step_m=0.6, seed=seed)
    scans, flakes = [], []
    for scan in clear:
        r = np.linalg.norm(scan.points(), axis=1)
        at = rng.uniform(2.5, far_m, len(r))
        hit = (rng.random(len(r)) < share) & (at < r)
        scale = np.where(hit, at / r, 1.0).astype(np.float32)
        strength = np.where(hit, 2.0 * rng.random(len(r)), rng.uniform(10.0, 50.0, len(r)))
        scans.append(
            dataclasses.replace(
                scan, x_m=scan.x_m * scale, y_m=scan.y_m * scale, z_m=scan.z_m * scale,
                intensity=strength.astype(np.float32),
            )
        )  # fmt: skip
        flakes.append(hit)
    return scans, flakes, sensors(poses)


def labels(
    scans: list[DeskewedScan], told: tuple[Imu, Wheel], settings: Settings | None = None
) -> list[NDArray[np.uint8]]:
    session = make_session(ROWS)
    return [each.class_ for each in denoise(settings or Settings(), Deskewed(scans), session, *told)]


def scores(found: list[NDArray[np.uint8]], flakes: list[B1]) -> tuple[float, float]:
    """Precision and recall."""
    named, true = np.concatenate(found) == AIRBORNE, np.concatenate(flakes)
    both = (named & true).sum()
    return both / max(named.sum(), 1), both / true.sum()


@pytest.mark.parametrize(("share", "least"), [(0.005, 0.85), (0.05, 0.92)])
@pytest.mark.parametrize("seed", [0, 1])
def test_snow_is_found_and_little_else(seed: int, share: float, least: float) -> None:
    scans, flakes, told = drifting(seed, share)
    precision, recall = scores(labels(scans, told), flakes)
    assert 0.9 < precision <= 1.0
    assert least < recall <= 1.0


@pytest.mark.parametrize("kind", ["zero", "constant", "nan"])
def test_without_intensities_half_of_the_snow_is_found(kind: str) -> None:
    scans, flakes, told = drifting(2, 0.05)
    value = {"zero": 0.0, "constant": 7.0, "nan": np.nan}[kind]
    blind = [dataclasses.replace(s, intensity=np.full(len(s), value, np.float32)) for s in scans]
    precision, recall = scores(labels(blind, told), flakes)
    assert 0.9 < precision <= 1.0
    assert 0.5 < recall <= 1.0


@pytest.mark.parametrize("seed", [3, 4])
def test_a_clear_street_loses_nothing_to_particles(seed: int) -> None:
    scans, _, told = drifting(seed, 0.0)
    named = np.concatenate(labels(scans, told)) == AIRBORNE
    assert named.mean() < 0.001


def test_wires_and_thin_poles_are_no_particles() -> None:
    wires = [[[-60.0, y - 0.02, h], [60.0, y + 0.02, h + 0.04]] for y, h in ((2.0, 2.5), (-3.0, 3.2))]
    poles = [[[x, 3.0, GROUND_Z_M], [x + 0.06, 3.06, 3.0]] for x in np.arange(-20.0, 30.0, 5.0)]
    world = BoxWorld(np.concatenate((street(0).boxes, wires, poles)))
    scans, _, told = drifting(5, 0.0, world)
    y, z = np.concatenate([s.y_m for s in scans]), np.concatenate([s.z_m for s in scans])
    named = np.concatenate(labels(scans, told)) == AIRBORNE
    thin = ((np.abs(y - 2.0) < 0.1) & (z > 2.3)) | ((np.abs(y + 3.0) < 0.1) & (z > 3.0))
    assert thin.sum() > 100
    assert named[thin].mean() < 0.02


def test_nothing_is_named_where_no_other_scan_can_be_asked() -> None:
    scans, _, told = drifting(6, 0.05)
    assert not (labels(scans[:1], told)[0] == AIRBORNE).any()
    alone = view(Settings(), scans[0], np.eye(4), ROWS)
    assert not airborne(Moment(alone, ())).any()
    thin = [scan.take(np.arange(0, len(scan), 400)) for scan in scans]  # too few points to register
    assert not any((classes == AIRBORNE).any() for classes in labels(thin, SILENT))


def test_where_sensors_are_silent_registration_serves() -> None:
    scans, flakes, _ = drifting(7, 0.03)
    precision, recall = scores(labels(scans, SILENT), flakes)
    assert precision > 0.9
    assert recall > 0.8


def test_the_first_and_last_scans_of_a_chunk_are_labelled_too() -> None:
    scans, flakes, told = drifting(8, 0.05)
    found = labels(scans[:3], told)
    for k in range(3):
        assert scores([found[k]], [flakes[k]])[1] > 0.85


def test_it_can_be_switched_off() -> None:
    scans, _, told = drifting(9, 0.05)
    assert not any((c == AIRBORNE).any() for c in labels(scans[:4], told, Settings(particles=False)))


@pytest.mark.parametrize("count", [0, 1])
def test_scans_of_no_or_one_point_and_of_nan(count: int) -> None:
    scans, _, told = drifting(10, 0.05)
    small = [scan.take(slice(0, count)) for scan in scans[:3]]
    assert [len(classes) for classes in labels(small, told)] == [count] * 3
    nan = np.full(50, np.nan, np.float32)
    broken = [dataclasses.replace(s.take(slice(0, 50)), x_m=nan, y_m=nan, z_m=nan) for s in scans[:3]]
    for classes in labels(broken, told):
        assert (classes == PointClass.OUT_OF_RANGE).all()


def test_the_shares_of_flakes_and_clouds_move_the_line() -> None:
    solid, sure, nothing = np.full(50, -4.0), np.full(500, 4.0), np.zeros(0)
    usual = np.log(SHARES / (1 - SHARES))
    lowest = CLEAR_AIR * (np.log(LEAST_SHARE / (1 - LEAST_SHARE)) - usual)
    np.testing.assert_allclose(shifts(nothing, nothing, 10_000), lowest)
    assert (np.array(shifts(solid, solid, 10_000)) < -1.0).all()
    flakes, clouds = shifts(sure, np.full(500, -8.0), 1000)
    assert flakes == MOST_SHIFT
    assert clouds < 0.0


def test_lonely_points_that_stay_are_no_outliers() -> None:
    spikes = [[[x, y, 0.2], [x + 0.05, y + 0.05, 0.6]] for x in range(-10, 20, 4) for y in (-6.0, 6.0)]
    world = BoxWorld(np.array([[[-60.0, 14.0, GROUND_Z_M], [60.0, 15.0, 0.1]], *spikes]))
    scans, _, told = drifting(11, 0.0, world)
    z = np.concatenate([scan.z_m for scan in scans])
    assert (z > 0.15).sum() > 30
    alone = np.concatenate([labels([scan], told)[0] for scan in scans]) == PointClass.OUTLIER
    among = np.concatenate(labels(scans, told)) == PointClass.OUTLIER
    assert among[z > 0.15].mean() < 0.5 * alone[z > 0.15].mean()
