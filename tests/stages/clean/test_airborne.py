"""What is in the air, decided with the map: dust over the road goes, leaves and cars that denoise took for dust come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanloom.schemas.clean import Standing
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.scans import PointClass, ScanLabels
from scanloom.stages.clean import incidence, signs, weights
from scanloom.stages.clean.airborne import (
    AFTERWARDS,
    ASKED,
    NO_STRENGTH,
    TAKEN,
    Known,
    airborne,
    by_standing,
    evidence,
    is_loose,
    light_of,
    may_fly,
    strengths,
    taken_next,
    things,
)
from scanloom.stages.clean.around import (
    AIR,
    DIM,
    GROUND,
    NOTHING,
    OFF_LINE,
    OTHER,
    SOLID,
    contrasts,
    look_around,
    off_line,
    over_ground,
    seen_ranges,
    stands_out,
)
from scanloom.stages.clean.field import brick_key, brick_table
from scanloom.stages.clean.lookup import standing, standing_around
from scanloom.stages.clean.relabel import Settings
from tests.stages.clean.worlds import Drive, car, cleared_of, drive_past, rays_of, relabelled, wall

WALLS = (wall(-20.0, 8.0, 100.0), wall(-20.0, -15.0, 100.0))
PARKED = car(22.0, 5.0)


def cloud(t: float) -> np.ndarray:
    """Where dust drifts over the road, ahead of the vehicle."""
    return np.array([[14.0 + 6.0 * t, -1.0, -1.5], [18.0 + 6.0 * t, 3.0, 0.5]])


def in_dust(seed: int, called_airborne: float, count: int = 40) -> tuple[Drive, list[np.ndarray]]:
    """A drive behind a drifting cloud in which some rays end; which of the points of each scan are dust."""
    rng = np.random.default_rng(seed)
    drive = drive_past([*WALLS, PARKED], [], count=count, seed=seed)
    dusty = []
    for n, scan in enumerate(drive.scans):
        p, ray = drive.world_points(n), drive.world_points(n) - drive.T[n, :3, 3]
        low, high = cloud(0.1 * n)
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - drive.T[n, :3, 3]) / ray, (high - drive.T[n, :3, 3]) / ray
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        met = (enter < leave) & (enter > 0) & (leave < 1) & (rng.random(len(p)) < 0.4)
        at = np.where(met, enter, 0.0) + np.where(met, leave - enter, 0.0) * rng.random(len(p))
        share = np.where(met, at, 1.0).astype(np.float32)
        strength = np.where(met, 5.0, 60.0) * rng.uniform(0.8, 1.2, len(p))
        drive.scans[n] = replace(
            scan, x_m=scan.x_m * share, y_m=scan.y_m * share, z_m=scan.z_m * share,
            intensity=strength.astype(np.float32),
        )  # fmt: skip
        named = np.where(rng.random(len(p)) < called_airborne, PointClass.AIRBORNE, PointClass.STATIC)
        kind = np.where(met, named, drive.labels[n].class_).astype(np.uint8)
        drive.labels[n] = ScanLabels(kind, scan.reference_ns, n)
        dusty.append(met)
    return drive, dusty


@pytest.mark.parametrize(("called_airborne", "least"), [(0.6, 0.85), (0.9, 0.95)])
def test_dust_that_denoise_named_in_part_is_named_and_what_stands_is_not(
    called_airborne: float, least: float
) -> None:
    drive, dusty = in_dust(1, called_airborne)
    final = [label.class_ for label in relabelled(drive, cleared_of(rays_of({"a": drive}))["a"])[0]]
    dust, found = np.concatenate(dusty), np.concatenate(final) == PointClass.AIRBORNE
    assert dust.sum() > 2000
    assert found[dust].mean() > least
    assert found[~dust].mean() < 0.001


def test_what_denoise_took_for_dust_and_stands_is_restored_and_the_rest_of_dust_stays() -> None:
    drive, dusty = in_dust(2, 1.0)
    rng = np.random.default_rng(3)
    wrong = []
    for n, label in enumerate(drive.labels):
        mistaken = (label.class_ == PointClass.STATIC) & (rng.random(len(label.class_)) < 0.03)
        drive.labels[n] = replace(
            label, class_=np.where(mistaken, PointClass.AIRBORNE, label.class_).astype(np.uint8)
        )
        wrong.append(mistaken)
    final = np.concatenate(
        [label.class_ for label in relabelled(drive, cleared_of(rays_of({"a": drive}))["a"])[0]]
    )
    wrongly, dust = np.concatenate(wrong), np.concatenate(dusty)
    assert wrongly.sum() > 2000
    assert (final[wrongly] == PointClass.AIRBORNE).mean() < 0.05
    assert (final[dust] == PointClass.AIRBORNE).mean() > 0.95


def test_without_the_last_word_denoise_is_kept_but_for_what_stands() -> None:
    drive, _ = in_dust(2, 0.6, count=20)
    cleared = cleared_of(rays_of({"a": drive}))["a"]
    final = np.concatenate(
        [label.class_ for label in relabelled(drive, cleared, settings=Settings(particles=False))[0]]
    )
    named = np.concatenate([label.class_ for label in drive.labels]) == PointClass.AIRBORNE
    assert (final[~named] != PointClass.AIRBORNE).all()
    assert (final[named] == PointClass.AIRBORNE).mean() > 0.9


def test_a_cloud_that_the_tracker_followed_is_air_and_a_car_in_it_moves() -> None:
    """The box holds the cloud whole; another, as large, a car whose returns denoise took for solid."""
    drive, dusty = in_dust(4, 0.9)

    def tracked(box_at: object) -> ObjectTracks:
        T = np.tile(np.eye(4), (len(drive.scans), 1, 1))
        for n in range(len(T)):
            low, high = box_at(0.1 * n)  # type: ignore[operator]
            T[n, :3, 3] = [*(low[:2] + high[:2]) / 2, low[2]]
        size = box_at(0.0)[1] - box_at(0.0)[0]  # type: ignore[operator]
        n = len(T)
        return ObjectTracks(
            scan_index=np.arange(n), stamp_ns=np.arange(n), track=np.zeros(n, np.int32), T_odom_object=T,
            T_lidar_object=np.linalg.inv(drive.T) @ T, length_m=np.full(n, size[0]), width_m=np.full(n, size[1]),
            height_m=np.full(n, size[2]), speed_m_s=np.full(n, 6.0), class_=np.ones(n, np.uint8),
            dynamic=np.ones(n, bool), score=np.ones(n),
        )  # fmt: skip

    cleared = cleared_of(rays_of({"a": drive}))["a"]
    dust = np.concatenate(dusty)
    final = np.concatenate([label.class_ for label in relabelled(drive, cleared, tracked(cloud))[0]])
    assert (final[dust] == PointClass.AIRBORNE).mean() > 0.9
    solid = [
        replace(label, class_=np.where(d, PointClass.STATIC, label.class_).astype(np.uint8))
        for label, d in zip(drive.labels, dusty)
    ]
    drive.labels[:] = solid
    final = np.concatenate([label.class_ for label in relabelled(drive, cleared, tracked(cloud))[0]])
    assert (final[dust] == PointClass.DYNAMIC).mean() > 0.95


def test_in_clear_air_nothing_is_in_it() -> None:
    drive = drive_past([*WALLS, PARKED], [lambda t: car(45.0 - 10.0 * t, 2.0)])
    final = relabelled(drive, cleared_of(rays_of({"a": drive}))["a"])[0]
    assert sum(int((label.class_ == PointClass.AIRBORNE).sum()) for label in final) == 0


def test_ground_and_what_both_agree_on_is_not_asked_about() -> None:
    solid = [PointClass.STATIC, PointClass.UNLABELLED]
    assert not ASKED[:, PointClass.GROUND].any()
    assert not ASKED[:, [PointClass.EGO, PointClass.OUT_OF_RANGE]].any()
    assert not ASKED[Standing.STANDS, solid].any()
    assert ASKED[Standing.STANDS, [PointClass.DYNAMIC, PointClass.AIRBORNE, PointClass.OUTLIER]].all()
    assert ASKED[np.ix_([Standing.UNKNOWN, Standing.MOVED, Standing.CHANGED], solid)].all()
    assert (TAKEN.shape, AFTERWARDS.shape) == ((len(Standing), len(PointClass)), (len(Standing),))


def known_of(drive: Drive, said: np.ndarray) -> Known:
    scan, n, classes = drive.scans[0], len(drive.scans[0]), drive.labels[0].class_
    image = incidence.new_image()
    cell, away_m = incidence.fill(scan.x_m, scan.y_m, scan.z_m, image)
    taken = by_standing(said, classes, TAKEN)
    light = light_of(scan, said)
    asked, contrast = may_fly(scan, classes, said, taken, cell, away_m, image, light)
    none = np.full(n, -1, np.int32), np.zeros(n, bool)
    around = np.zeros((n, 2), np.uint8)
    return Known(classes, said, *none, cell, away_m, image, taken, asked, around, contrast, light)


def test_evidence_stays_within_its_tables() -> None:
    drive, _ = in_dust(5, 0.5, count=1)
    rng = np.random.default_rng(0)
    scan = drive.scans[0]
    known = known_of(drive, rng.integers(0, 4, len(scan)).astype(np.uint8))
    known = replace(known, near=rng.integers(0, 27, (len(scan), 2)).astype(np.uint8))
    asked, loose, taken = known.asked, is_loose(known), known.taken
    thing, strength = things(known, loose, 0.4), strengths(scan, known)
    ranges = seen_ranges(known.away_m, taken, known.image)
    found = evidence(scan, known, ranges, thing, loose, strength, taken, asked)
    assert np.array_equal(taken, TAKEN[known.said, known.classes])
    assert found.shape == (len(asked), signs.KINDS)
    assert found.max() < weights.BINS
    assert len(np.unique(found[:, signs.WHAT])) >= 5
    assert found[:, signs.THING].max() <= 34
    assert found[:, signs.FAR].max() <= 14
    assert set(np.unique(found[:, signs.BOX])) <= {12, 13}
    assert len(np.unique(found[:, signs.WEATHER])) == 1
    assert len(np.unique(found[:, signs.NEAR_STANDS] // signs.CLASSES)) == 5
    assert (taken == AIR).sum() > 10
    assert found[:, signs.CONTRAST].max() < 5 * 15
    assert found[:, signs.ROUGH].max() < 2 * OFF_LINE**2
    assert len(np.unique(found[:, signs.CONTRAST])) >= 8
    assert len(np.unique(found[:, signs.ROUGH])) >= 10


def test_ground_is_made_of_no_thing_and_stays_ground_when_it_does_not_fly() -> None:
    drive, _ = in_dust(5, 0.5, count=1)
    drive.labels[0].class_[:] = PointClass.STATIC
    drive.labels[0].class_[:10] = PointClass.GROUND
    known = known_of(drive, np.where(np.arange(len(drive.scans[0])) < 15, 0, 1).astype(np.uint8))
    assert not is_loose(known)[:10].any()
    assert not is_loose(known)[15:].any()
    rows = np.array([0, 1, 12, 13, 20])
    after = taken_next(known, rows, np.array([True, False, True, False, False]))
    assert after.tolist() == [AIR, GROUND, AIR, OTHER, SOLID]


def test_what_is_nearer_than_both_its_neighbours_sticks_out() -> None:
    angle = np.radians(np.arange(-5.0, 6.0) * 0.35)
    for off, is_out in ((0.25, False), (0.35, True)):
        r = np.full(11, 10.0)
        r[5] -= off
        x, y = (r * np.cos(angle)).astype(np.float32), (r * np.sin(angle)).astype(np.float32)
        image = incidence.new_image()
        cell, away_m = incidence.fill(x, y, np.zeros_like(x), image)
        for class_ in (PointClass.GROUND, PointClass.STATIC, PointClass.EGO, PointClass.OUT_OF_RANGE):
            classes, dark = np.full(11, class_, np.uint8), np.zeros(11, np.float32)
            found = stands_out(away_m, dark, 0.0, classes, cell, image)
            counted = class_ in (PointClass.GROUND, PointClass.STATIC)
            assert found.tolist() == [is_out and counted and n == 5 for n in range(11)]


def test_ground_is_asked_about_under_what_is_in_the_air_close_by() -> None:
    """At 10 m, 0.9 m is near; the image holds 4 cells of 0.35 degrees to each side."""
    angle = np.radians([0.0, 0.7, 1.2, 2.5, 0.7])
    r = np.array([10.0, 10.0, 10.95, 10.0, 10.0])
    x, y = (r * np.cos(angle)).astype(np.float32), (r * np.sin(angle)).astype(np.float32)
    z = np.array([0.0, 0.0, 0.0, 0.0, -0.1], np.float32)
    classes = np.full(5, PointClass.GROUND, np.uint8)
    classes[0], classes[4] = PointClass.AIRBORNE, PointClass.STATIC
    image = incidence.new_image()
    cell, away_m = incidence.fill(x, y, z, image)
    taken = np.where(classes == PointClass.AIRBORNE, AIR, OTHER).astype(np.uint8)
    assert over_ground(x, y, z, away_m, classes, taken, cell, image).tolist() == [
        False, True, False, False, False,
    ]  # fmt: skip
    assert not over_ground(x, y, z, away_m, classes, np.full(5, OTHER, np.uint8), cell, image).any()


def test_standing_and_gone_voxels_around_are_counted_across_bricks_without_the_own() -> None:
    verdict = np.zeros((2, 8, 8, 8), np.uint8)
    verdict[0, 7, 3, 3], verdict[0, 7, 4, 3], verdict[0, 6, 3, 3] = (
        Standing.STANDS,
        Standing.MOVED,
        Standing.STANDS,
    )
    verdict[1, 0, 3, 3], verdict[1, 1, 3, 3] = Standing.STANDS, Standing.CHANGED
    keys, rows = brick_table(np.array([brick_key(0, 0, 0), brick_key(8, 0, 0)], np.int64), 2)
    x, y, z = (np.array([each, each], np.float32) for each in (1.7, 0.7, 0.7))
    asked = np.array([0])
    said = standing_around(x, y, z, asked, np.eye(4), 5.0, keys, rows, verdict.reshape(2, 512))
    assert said.tolist() == [[1, 2], [0, 0]]


@pytest.mark.parametrize("intensity", [0.0, np.nan])
def test_a_sensor_that_tells_no_intensity_is_not_asked_for_it(intensity: float) -> None:
    drive, _ = in_dust(6, 0.5, count=1)
    scan = replace(drive.scans[0], intensity=np.full(len(drive.scans[0]), intensity, np.float32))
    known = known_of(replace(drive, scans=[scan]), np.ones(len(scan), np.uint8))
    assert known.light is None
    assert not known.contrast.any()
    assert (strengths(scan, known) == NO_STRENGTH).all()
    assert airborne(scan, known, 0.4).shape == (len(scan),)


def test_an_intensity_that_is_rounded_off_tells_nothing() -> None:
    drive, dusty = in_dust(6, 0.5, count=1)
    scan, dust = drive.scans[0], dusty[0]
    known = known_of(drive, np.where(dust, 0, 1).astype(np.uint8))
    rows = np.flatnonzero(dust)
    assert (strengths(scan, known)[rows] < NO_STRENGTH).all()
    rounded = scan.intensity.copy()
    rounded[dust], rounded[np.flatnonzero(~dust)[::16]] = 0.0, 0.0
    scan = replace(scan, intensity=rounded)
    known = known_of(replace(drive, scans=[scan]), known.said)
    assert known.light is not None
    assert known.light.lost == 0.0
    assert (strengths(scan, known)[rows] == NO_STRENGTH).all()
    assert not known.contrast[rows].any()


def test_voxels_around_are_those_of_each_by_itself() -> None:
    rng = np.random.default_rng(4)
    corners = np.array([[i, j, k] for i in range(-16, 16, 8) for j in range(-16, 16, 8) for k in (-8, 0)])
    bricks = np.array([brick_key(*corner) for corner in corners], np.int64)[
        rng.permutation(len(corners))[:24]
    ]
    keys, rows = brick_table(bricks, len(bricks))
    verdict = rng.integers(0, 4, (len(bricks), 512)).astype(np.uint8)
    at = rng.integers(-17, 17, (3, 500))
    x, y, z = ((each + 0.5).astype(np.float32) for each in at)
    table = keys, rows, verdict
    found = standing_around(x, y, z, np.arange(500), np.eye(4), 1.0, *table)
    expected = np.zeros((500, 2), int)
    for step in np.ndindex(3, 3, 3):
        u, v, w = ((each + s - 1).astype(np.float32) for each, s in zip((x, y, z), step))
        said = standing(u, v, w, np.zeros(500, np.uint8), np.ones(1, bool), np.eye(4), 1.0, *table)
        if step != (1, 1, 1):
            expected += np.column_stack((said == Standing.STANDS, said > Standing.STANDS))
    assert np.array_equal(found, expected)
    assert expected.max() > 8


def test_what_lies_around_is_counted_as_one_by_one() -> None:
    rng = np.random.default_rng(6)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(-0.2, 0.1, 6000)
    r = rng.choice([8.0, 8.3, 9.5, 20.0], 6000) + rng.uniform(-0.2, 0.2, 6000)
    level = r * np.cos(elevation)
    x, y, z = (
        each.astype(np.float32)
        for each in (level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation))
    )
    image = incidence.new_image()
    cell, away_m = incidence.fill(x, y, z, image)
    taken = rng.integers(0, 6, 6000).astype(np.uint8)
    ranges = seen_ranges(away_m, taken, image)
    points = np.column_stack((x, y, z)).astype(float)
    row, column = np.divmod(cell, incidence.COLUMNS)
    around, ground_m, beyond = np.zeros(6, np.int64), np.zeros(1), 0
    for n in range(200):
        look_around(x, y, z, away_m, n, cell[n], image, ranges, taken, around, ground_m)
        aside = (column - column[n] + 512) % incidence.COLUMNS - 512
        there = (abs(row - row[n]) <= 3) & (abs(aside) <= 4) & (image.ravel()[cell] == np.arange(6000))
        there &= (taken != NOTHING) & (np.arange(6000) != n)
        distance = np.linalg.norm(points - points[n], axis=1)
        near = there & (distance < 0.6 + 0.03 * away_m[n])
        expected = np.bincount(taken[near], minlength=6)
        expected[NOTHING] = (there & ~near & (away_m > away_m[n])).sum()
        assert np.array_equal(around, expected)
        assert ground_m[0] == pytest.approx(z[near & (taken == GROUND)].sum(), abs=1e-5)
        beyond += expected[NOTHING]
    assert beyond > 100


@pytest.mark.parametrize(
    ("own", "left", "right", "left_m", "found"),
    [
        (7.9, 100.0, 100.0, 10.0, 1), (8.1, 100.0, 100.0, 10.0, 2), (20.0, 100.0, 100.0, 10.0, 3),
        (26.0, 100.0, 100.0, 10.0, 4), (20.0, 100.0, 20.0, 10.0, 7), (99.0, 100.0, 120.0, 10.8, 7),
        (20.0, 100.0, 100.0, 12.0, 10), (90.0, 100.0, 100.0, 12.0, 14), (20.0, 2.0, 100.0, 10.0, 10),
        (2.0, 100.0, 100.0, 10.0, 0), (np.nan, 100.0, 100.0, 10.0, 0),
    ],
)  # fmt: skip
def test_contrast_is_told_against_the_fainter_of_what_is_near_beside(
    own: float, left: float, right: float, left_m: float, found: int
) -> None:
    """At 10 m, 0.9 m is near; intensities up to 2 are lost."""
    angle = np.radians([-0.2, 0.15, 0.5])
    r = np.array([left_m, 10.0, 10.2])
    x, y = (r * np.cos(angle)).astype(np.float32), (r * np.sin(angle)).astype(np.float32)
    image = incidence.new_image()
    cell, away_m = incidence.fill(x, y, np.zeros_like(x), image)
    intensity = np.array([left, own, right], np.float32)
    for class_ in (PointClass.GROUND, PointClass.EGO):
        classes = np.full(3, class_, np.uint8)
        out = stands_out(away_m, intensity, 2.0, classes, cell, image)
        assert out[1] == (class_ == PointClass.GROUND and 0 < found <= DIM)
    contrast = contrasts(away_m, intensity, 2.0, cell, image, np.array([1]))
    assert contrast.tolist() == [0, found, 0]


@pytest.mark.parametrize(
    ("off_m", "found"),
    [(0.0, 1), (0.09, 1), (-0.09, 1), (0.15, 2), (-0.35, 2), (0.45, 3), (1.75, 3), (1.9, 4), (-0.45, 5)],
)
def test_a_return_lies_on_before_or_behind_the_line_between_others(off_m: float, found: int) -> None:
    """On a wall 10 m to the side the noise is 0.1 m; before it less, with the range."""
    way = np.arange(-2, 2) * 2 * np.pi / incidence.COLUMNS
    ranges = np.zeros((incidence.ROWS, incidence.COLUMNS), np.float32)
    ranges[100, 498:502] = 10.0 / np.cos(way)
    ranges[[97, 102], 600] = 10.0
    assert off_line(ranges, 100, 500, 10.0 - off_m, 0, 1, 2) == found
    assert off_line(ranges, 100, 600, 10.0 - off_m, 1, 0, 4) == found
    assert off_line(ranges, 100, 600, 10.0 - off_m, 1, 0, 2) == 0
    assert off_line(ranges, 100, 503, 10.0, 0, 1, 2) == 0
    assert off_line(ranges, 0, 600, 10.0, 1, 0, 4) == 0
