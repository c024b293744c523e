"""Range image and segments: the angle criterion as its formula says, at seams and gaps, with and without intensities."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.range_image import BINS, ImageSettings, RangeImage, range_image
from scanloom.stages.loops.segmentation import SegmentationSettings, belong_together, calibrated, segments
from tests.stages.loops.worlds import START_NS
from tests.worlds import BoxWorld, observe

F4 = np.ndarray
STEP = np.radians(0.2)
COLUMNS = 360
NO_ROWS = np.zeros(BINS, np.int32)


def image_of(ranges: F4, elevation_deg: F4 | None = None) -> tuple[RangeImage, F4]:
    """An image (rows, columns) of given ranges, 0 for empty cells, and the points it shows."""
    rows, columns = ranges.shape
    elevation = np.radians(np.arange(rows) * 0.4 if elevation_deg is None else elevation_deg)
    filled = ranges > 0
    point = np.full(ranges.shape, -1, np.int32)
    point[filled] = np.arange(filled.sum())
    azimuth = np.broadcast_to(2 * np.pi * (np.arange(columns) + 0.5) / columns - np.pi, ranges.shape)
    up = np.broadcast_to(elevation[:, None], ranges.shape)
    direction = np.stack((np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)), axis=-1)
    xyz = (direction * ranges[..., None])[filled].astype(np.float32)
    return RangeImage(point, ranges.astype(np.float32), elevation, 2 * np.pi / columns, NO_ROWS, NO_ROWS), xyz


def labels_of_ranges(ranges: F4, intensity: float | F4 = np.nan, **settings: object) -> F4:
    image, xyz = image_of(ranges)
    strength = np.broadcast_to(np.asarray(intensity, np.float32), len(xyz)).copy()
    return segments(SegmentationSettings(**settings), image, xyz, strength)


# --------------------------------------------------------------------------------------------------------- the criterion


@pytest.mark.parametrize(("angle_deg", "jump_m"), [(50, 0.058), (55, 0.048), (60, 0.040), (65, 0.032)])
def test_the_range_jump_at_which_neighbours_part(angle_deg: float, jump_m: float) -> None:
    """At 20 m and 0.2 deg the permitted jump is 5.8, 4.9, 4.0, 3.2 cm, to half a millimetre (methods 2.3)."""
    settings = SegmentationSettings(angle_deg=angle_deg)
    exact = 20.0 * (np.cos(STEP) + np.sin(STEP) / np.tan(np.radians(angle_deg))) - 20.0
    assert exact == pytest.approx(jump_m, abs=1.1e-3)
    for r1, r2 in ((20.0, 20.0 + exact - 5e-4), (20.0 + exact - 5e-4, 20.0)):
        assert belong_together(settings, r1, r2, STEP, np.nan)
    for r1, r2 in ((20.0, 20.0 + exact + 5e-4), (20.0 + exact + 5e-4, 20.0)):
        assert not belong_together(settings, r1, r2, STEP, np.nan)


@pytest.mark.parametrize(
    ("rule", "difference", "angle_deg"),
    [
        ("plain", 0.0, 60), ("hard", 0.0, 50), ("hard", 0.49, 50), ("linear", 0.0, 50), ("linear", 0.25, 52.5),
        ("linear", 0.499, 54.99),
    ],
)  # fmt: skip
def test_like_intensities_relax_the_angle(rule: str, difference: float, angle_deg: float) -> None:
    settings = SegmentationSettings(rule=rule, relaxation_deg=10, alike=1.0)
    jump = 20.0 * (np.cos(STEP) + np.sin(STEP) / np.tan(np.radians(angle_deg))) - 20.0
    assert belong_together(settings, 20.0, 20.0 + jump - 3e-4, STEP, difference)
    assert not belong_together(settings, 20.0, 20.0 + jump + 3e-4, STEP, difference)


@pytest.mark.parametrize("rule", ["hard", "linear"])
def test_unlike_intensities_do_not_relax_it(rule: str) -> None:
    settings = SegmentationSettings(rule=rule, alike=0.2, max_difference=0.5)
    assert not belong_together(settings, 20.0, 20.045, STEP, 0.3)
    assert belong_together(settings, 20.0, 20.03, STEP, 0.3)


def test_very_unlike_intensities_part_neighbours_whatever_the_angle() -> None:
    settings = SegmentationSettings()
    assert belong_together(settings, 20.0, 20.0, STEP, 0.5)
    assert not belong_together(settings, 20.0, 20.0, STEP, 0.5001)
    assert belong_together(settings, 20.0, 20.0, STEP, np.nan)


# ------------------------------------------------------------------------------------------------------------- labelling


def test_a_surface_goes_on_over_the_seam_behind_the_sensor() -> None:
    ranges = np.zeros((4, COLUMNS))
    ranges[:, :6] = ranges[:, -6:] = 10.0
    label = labels_of_ranges(ranges)
    assert set(np.unique(label)) == {0, 1}
    assert (label > 0).sum() == 4 * 12


@pytest.mark.parametrize(("gap", "parts"), [(0, 2), (1, 1)])
def test_an_empty_column_is_looked_over(gap: int, parts: int) -> None:
    ranges = np.zeros((4, COLUMNS))
    ranges[:, 100:120] = 10.0
    ranges[:, 110] = 0.0
    assert labels_of_ranges(ranges, gap_cells=gap).max() == parts
    ranges[:, 111] = 0.0
    assert labels_of_ranges(ranges, gap_cells=gap).max() == 2


def test_two_surfaces_one_behind_the_other_are_two_segments() -> None:
    ranges = np.zeros((4, COLUMNS))
    ranges[:, 100:120], ranges[:, 120:140] = 10.0, 14.0
    label = labels_of_ranges(ranges)
    assert label.max() == 2
    assert label[0, 119] != label[0, 120]


@pytest.mark.parametrize(
    ("rows", "columns", "counts"), [(1, 30, True), (1, 29, False), (3, 2, True), (2, 3, False), (4, 1, False), (5, 1, True)]
)  # fmt: skip
def test_which_segments_count(rows: int, columns: int, counts: bool) -> None:
    """30 points, or 5 over three rows."""
    ranges = np.zeros((6, COLUMNS))
    ranges[:rows, 50 : 50 + columns] = 10.0
    assert bool(labels_of_ranges(ranges).max()) is counts


def test_an_image_without_points_has_no_segments() -> None:
    assert not labels_of_ranges(np.zeros((3, COLUMNS))).any()


# ----------------------------------------------------------------------------------------------------------- intensities


def test_intensity_is_that_of_an_upright_surface_at_the_reference_range() -> None:
    """I (r / r_ref)^2 / cos(incidence) is the same all over a wall of one material."""
    rows, columns = 9, 1440
    elevation = np.radians(np.linspace(-4, 4, rows))
    azimuth = 2 * np.pi * (np.arange(columns) + 0.5) / columns - np.pi
    seen = np.abs(azimuth) < np.radians(50)
    direction = np.cos(elevation)[:, None] * np.cos(azimuth)
    ranges = np.where(seen, 10.0 / np.where(seen, direction, 1.0), 0.0)
    image, xyz = image_of(ranges, np.degrees(elevation))
    r = np.linalg.norm(xyz, axis=1)
    measured = (40.0 * (10.0 / r) ** 2 * (10.0 / r)).astype(np.float32)
    out = calibrated(SegmentationSettings(), image, xyz, measured)
    np.testing.assert_allclose(out[ranges > 0], 1.0, atol=0.02)
    assert np.isnan(out[ranges == 0]).all()


@pytest.mark.parametrize("intensity", [0.0, -1.0, np.nan, np.inf])
def test_a_sensor_without_intensities_knows_none(intensity: float) -> None:
    image, xyz = image_of(np.full((3, COLUMNS), 10.0))
    out = calibrated(SegmentationSettings(), image, xyz, np.full(len(xyz), intensity, np.float32))
    assert np.isnan(out).all()
    assert labels_of_ranges(np.full((3, COLUMNS), 10.0), intensity).max() == 1


def test_bright_points_are_clipped() -> None:
    image, xyz = image_of(np.full((3, COLUMNS), 10.0))
    intensity = np.full(len(xyz), 1.0, np.float32)
    intensity[5] = 1e4
    assert np.nanmax(calibrated(SegmentationSettings(), image, xyz, intensity)) == pytest.approx(10.0)


# ------------------------------------------------------------------------------------------------------------ range image


@pytest.mark.parametrize(("rows", "columns"), [(16, 512), (24, 600), (64, 1024)])
def test_each_beam_gets_a_row_and_each_firing_a_column(rows: int, columns: int) -> None:
    rng = np.random.default_rng(0)
    boxes = [
        [[x, y, -1.8], [x + 3, y + 3, 14.0]] for x, y in rng.uniform(-60, 60, (60, 2)) if np.hypot(x, y) > 16
    ]
    scan = observe(
        BoxWorld(np.array(boxes)), np.eye(4), stamp_ns=START_NS, rng=rng, rows=rows, columns=columns
    )
    every = np.ones(len(scan), np.bool_)
    image = range_image(ImageSettings(columns=4000), scan.x_m, scan.y_m, scan.z_m, every, every)
    up = np.degrees(np.arctan2(scan.z_m, np.hypot(scan.x_m, scan.y_m)))
    seen = len(np.unique(np.round((up + 20) / 30 * (rows - 1))))
    assert abs(image.point.shape[0] - seen) <= 1
    assert 0.9 * columns <= image.point.shape[1] <= columns
    cells = image.point[image.point >= 0]
    assert len(np.unique(cells)) == len(cells)
    assert len(cells) > 0.93 * len(scan)
    r = np.linalg.norm(scan.points()[cells], axis=1)
    np.testing.assert_allclose(image.range_m[image.point >= 0], r, rtol=1e-5)


def test_beams_that_blur_get_even_rows() -> None:
    rng = np.random.default_rng(1)
    azimuth, up = rng.uniform(-np.pi, np.pi, 40_000), np.radians(rng.uniform(-25, 3, 40_000))
    p = (30.0 * np.stack((np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)))).astype(
        np.float32
    )
    every = np.ones(40_000, np.bool_)
    image = range_image(ImageSettings(), *p, every, every)
    assert image.point.shape[0] == 64
    np.testing.assert_allclose(np.diff(image.elevation_rad), np.radians(28 / 64), rtol=0.1)


def test_of_two_points_in_a_cell_the_nearer_is_drawn() -> None:
    x = np.array([20.0, 10.0, 15.0], np.float32)
    zero = np.zeros(3, np.float32)
    every = np.ones(3, np.bool_)
    image = range_image(ImageSettings(), x, zero, zero, every, every)
    assert image.point[image.point >= 0].tolist() == [1]


def test_only_what_is_to_be_drawn_is_drawn() -> None:
    x = np.array([20.0, -10.0, np.nan], np.float32)
    zero = np.zeros(3, np.float32)
    image = range_image(ImageSettings(), x, zero, zero, np.ones(3, np.bool_), np.array([True, False, True]))
    assert image.point[image.point >= 0].tolist() == [0]
