"""Deskew of real, fast turning scans (Newer College, handheld) against the points another tool published.

No IMU and no neighbouring scans came with the three scans, and from the scans alone their motion cannot be had: all three
registered together, each with a twist of its own, leave it open by metres per second. So the motion is read from
some of the published points and given as gyro and wheel; what is tested, on the other points, is all that follows.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.handheld import (
    EVERY,
    SCANS,
    START_NS,
    SWEEP_S,
    deskewed,
    load,
    published_motion,
    range_differences,
)
from scanloom.schemas.scans import Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.deskew import Settings, deskew
from scanloom.stages.geometry.se3 import pose, so3_exp, transform

pytestmark = pytest.mark.real

FOLDER = "deskew_newer_06"
AGREED_M = 0.03
TENTH_S_NS = 100_000_000


@pytest.mark.parametrize("i", range(SCANS))
def test_with_the_published_motion_every_range_agrees(shared_data: Path, i: int) -> None:
    sweep = load(shared_data / FOLDER, i)
    ranges = range_differences(sweep, deskewed(sweep, walking=True))
    assert len(ranges) > 0.9 * len(sweep.scan) > 18_000
    assert 1e-4 < np.median(ranges) < 0.2 * AGREED_M
    assert np.percentile(ranges, 95) < 0.5 * AGREED_M
    assert ranges.max() < AGREED_M


@pytest.mark.parametrize("i", range(SCANS))
def test_with_the_published_motion_the_published_points_come_out(shared_data: Path, i: int) -> None:
    sweep = load(shared_data / FOLDER, i)
    moving = (sweep.seconds > 0.005) & (sweep.seconds < 0.09)  # at both ends the other tool held the motion
    before, after = (
        np.linalg.norm(points - sweep.published, axis=1)[moving]
        for points in (sweep.scan.points(), deskewed(sweep, walking=True))
    )
    assert np.median(before) > 0.2
    assert 1e-4 < np.median(after) < 0.015
    assert np.percentile(after, 95) < 0.03 * np.percentile(before, 95)


@pytest.mark.parametrize("i", range(SCANS))
def test_with_its_rotation_alone_ranges_miss_the_way_within_the_sweep_and_nothing_else(
    shared_data: Path, i: int
) -> None:
    sweep = load(shared_data / FOLDER, i)
    points = deskewed(sweep, walking=False)
    ranges = np.linalg.norm(points, axis=1)
    assert np.abs(ranges - np.linalg.norm(sweep.scan.points(), axis=1)).max() < 1e-3  # turning keeps ranges
    share = sweep.seconds / SWEEP_S
    way = np.column_stack((share, share**2)) @ published_motion(sweep).found[:, 3:]
    seen_along_the_ray = np.einsum("ni,ni->n", points, way) / ranges
    missed = np.linalg.norm(sweep.published, axis=1) - ranges
    assert np.percentile(np.abs(missed), 95) > 0.02
    assert np.abs(missed - seen_along_the_ray).max() < 0.015


@pytest.mark.parametrize("i", range(SCANS))
def test_at_the_middle_of_the_sweep_it_is_the_same_cloud_seen_from_there(shared_data: Path, i: int) -> None:
    sweep = load(shared_data / FOLDER, i)
    scan = dataclasses.replace(sweep.scan, reference_ns=START_NS + TENTH_S_NS // 2)
    at_middle = deskewed(dataclasses.replace(sweep, scan=scan), walking=True, motion=published_motion(sweep))
    half = np.array([0.5, 0.25]) @ published_motion(sweep).found
    T_start_middle = pose(so3_exp(half[:3]), half[3:])
    at_start = deskewed(sweep, walking=True)
    apart = np.linalg.norm(transform(T_start_middle, at_middle) - at_start, axis=1)
    assert np.linalg.norm(at_middle - at_start, axis=1).max() > 1.0
    assert 1e-6 < apart.max() < 0.01  # a wheel knows no way to the side


def test_the_motion_is_read_from_few_points_and_is_that_of_all(shared_data: Path) -> None:
    sweep = load(shared_data / FOLDER, 2)
    others = dataclasses.replace(
        sweep, scan=dataclasses.replace(sweep.scan, **{k: np.roll(v, EVERY // 2) for k, v in columns(sweep.scan).items()}),
        published=np.roll(sweep.published, EVERY // 2, axis=0),
    )  # fmt: skip
    one, other = published_motion(sweep).found, published_motion(others).found
    assert 0 < np.abs(one - other).max() < 0.02


def test_scans_that_do_not_belong_together_are_left_alone(shared_data: Path) -> None:
    scans = [load(shared_data / FOLDER, i).scan for i in range(SCANS)]
    close = [
        dataclasses.replace(s, stamp_ns=s.stamp_ns + s.scan_index * TENTH_S_NS,
                            reference_ns=s.reference_ns + s.scan_index * TENTH_S_NS + TENTH_S_NS // 2)
        for s in scans
    ]  # fmt: skip
    out = [*iter(deskew(Settings(), Scans(close), session(), Imu.empty(), Wheel.empty()))]
    assert [s.points().tobytes() for s in out] == [s.points().tobytes() for s in close]


def columns(scan: object) -> dict[str, np.ndarray]:
    return {name: value for name, value in vars(scan).items() if isinstance(value, np.ndarray)}


def session() -> Session:
    return Session(
        name="newer 06", format="point files", start_ns=START_NS, end_ns=START_NS + 10**9, scan_count=SCANS,
        point_count=70_000, scan_rate_hz=10.0, beams=64, point_time="per point", topics=(), extrinsics=(), problems=(),
        complete=True,
    )  # fmt: skip
