"""Figures of cleaning: what is near, the four accuracies, boxes as truth; on clouds made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.clean_boxes import BoxTrack, boxed, in_box, moves
from benchmarks.clean_nearness import near
from benchmarks.clean_page import END, START, fill, tables
from benchmarks.clean_scores import (
    UNJUDGED,
    Accuracy,
    accuracy,
    by_range,
    is_dynamic,
    is_static,
    kept_in_map,
    may_stand,
)
from benchmarks.clean_truth import WAITS_SCANS, waiting_cars
from benchmarks.scores import Figure
from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.schemas.simulated import TrueTracks
from scanloom.stages.geometry.se3 import F8, pose, so3_exp


def cloud(*rows: tuple[float, float, float]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, 3)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_reach_itself_is_near_and_a_hair_more_is_not(axis: int, side: float) -> None:
    there = np.zeros((1, 3), np.float32)
    at, beyond = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32)
    at[0, axis] = side * np.float32(0.05)
    beyond[0, axis] = side * np.nextafter(np.float32(0.05), np.float32(1.0))
    assert near(there, at, 0.05).tolist() == [True]
    assert near(there, beyond, 0.05).tolist() == [False]
    assert near(at, there, 0.05).tolist() == [True]
    assert near(beyond, there, 0.05).tolist() == [False]


def test_near_is_a_sphere_not_a_cube() -> None:
    assert near(cloud((0, 0, 0)), cloud((0.04, 0.04, 0)), 0.05).tolist() == [False]
    assert near(cloud((0, 0, 0)), cloud((0.03, 0.0399, 0)), 0.05).tolist() == [True]


def test_near_agrees_with_all_distances() -> None:
    rng = np.random.default_rng(3)
    queries = rng.uniform(-1, 1, (400, 3)).astype(np.float32)
    points = rng.uniform(-1, 1, (3000, 3)).astype(np.float32)
    apart = np.linalg.norm(queries[:, None].astype(float) - points[None], axis=2).min(axis=1)
    found = near(queries, points, 0.1)
    assert 50 < found.sum() < 350
    assert np.array_equal(found, apart <= np.float32(0.1))


def test_nothing_is_near_nothing() -> None:
    assert near(cloud((1, 2, 3)), cloud(), 0.05).tolist() == [False]
    assert near(cloud(), cloud((1, 2, 3)), 0.05).tolist() == []


def test_a_removed_point_beside_a_kept_one_counts_as_kept() -> None:
    points = cloud((0, 0, 0), (0.05, 0, 0), (0.2, 0, 0), (5, 0, 0))
    kept = np.array([True, False, False, True])
    assert kept_in_map(points, kept, np.ones(4, bool)).tolist() == [True, True, False, True]
    # One that nobody judges is not looked up.
    assert kept_in_map(points, kept, np.array([True, False, True, True])).tolist() == [
        True, False, False, True,
    ]  # fmt: skip
    assert kept.tolist() == [True, False, False, True]


def test_accuracies_by_hand() -> None:
    static = np.array([1, 1, 1, 1, 0, 0, 0, 0, 0], bool)
    dynamic = np.array([0, 0, 0, 0, 1, 1, 1, 1, 0], bool)
    held = np.array([1, 1, 1, 0, 1, 0, 0, 1, 1], bool)
    found = accuracy(static, dynamic, held)
    assert found == Accuracy(4, 3, 4, 2)
    assert found.sa == 75.0
    assert found.da == 50.0
    assert found.aa == pytest.approx(np.sqrt(75.0 * 50.0))
    assert found.ha == pytest.approx(60.0)


def test_a_map_of_everything_and_a_map_of_nothing() -> None:
    everything, nothing = Accuracy(10, 10, 5, 0), Accuracy(10, 0, 5, 5)
    assert (everything.sa, everything.da, everything.aa, everything.ha) == (100.0, 0.0, 0.0, 0.0)
    assert (nothing.sa, nothing.da, nothing.aa, nothing.ha) == (0.0, 100.0, 0.0, 0.0)


def test_without_moving_points_there_is_no_dynamic_accuracy() -> None:
    quiet = Accuracy(10, 9, 0, 0)
    assert quiet.sa == 90.0
    assert np.isnan(quiet.da) and np.isnan(quiet.aa) and np.isnan(quiet.ha)
    assert quiet.merit == 90.0


def test_who_is_in_which_set() -> None:
    classes = np.array([int(c) for c in PointClass], np.uint8)
    static, dynamic = set(classes[is_static(classes)]), set(classes[is_dynamic(classes)])
    assert static == {PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC}
    assert dynamic == {PointClass.DYNAMIC}
    assert set(classes[may_stand(classes)]) == static | {UNJUDGED}


def test_rings_hold_their_lower_bound() -> None:
    points = cloud((0, 0, 0), (19.99, 0, 0), (0, 20, 0), (0, 0, 40), (100, 0, 0))
    static = np.ones(5, bool)
    rings = dict(by_range(points, static, ~static, np.array([1, 0, 1, 0, 1], bool)))
    assert {name: (ring.static, ring.static_kept) for name, ring in rings.items()} == {
        "0_20_m": (2, 1), "20_40_m": (1, 1), "40_100_m": (1, 0),
    }  # fmt: skip


BOX = pose(so3_exp([0.0, 0.0, np.pi / 2]), [10.0, 0.0, -1.7])
SIZE = np.array([4.0, 2.0, 1.5])


def test_a_box_has_margins_and_leaves_out_the_road() -> None:
    across, along, up = 1.0, 2.0, -1.7 + 1.5
    inside = [(10, 0, -1), (10 + across + 0.09, 0, -1), (10, along + 0.09, -1), (10, 0, up + 0.09)]
    outside = [(10 + across + 0.11, 0, -1), (10, along + 0.11, -1), (10, 0, up + 0.11), (10, 0, -1.51)]
    assert in_box(np.array(inside, float), BOX, SIZE).all()
    assert not in_box(np.array(outside, float), BOX, SIZE).any()
    assert in_box(np.array([[10, 0, -1.49]]), BOX, SIZE).all()


def scan(points: np.ndarray, index: int) -> DeskewedScan:
    x, y, z = np.ascontiguousarray(points.astype(np.float32).T)
    return DeskewedScan(x, y, z, np.zeros(len(x), np.float32), reference_ns=0, scan_index=index)


@pytest.mark.parametrize(("moving", "expected"), [(True, PointClass.DYNAMIC), (False, PointClass.STATIC)])
def test_points_in_boxes_are_judged_and_no_others(moving: bool, expected: PointClass) -> None:
    tracks = [BoxTrack(3, "Van", {7: BOX}, SIZE, moving)]
    points = np.array([[10.0, 0, -1], [0, 0, 0]])
    classes, numbers = boxed(scan(points, 7), tracks, UNJUDGED)
    assert classes.tolist() == [expected, UNJUDGED]
    assert numbers.tolist() == [3, 0]
    assert boxed(scan(points, 8), tracks, UNJUDGED)[1].tolist() == [0, 0]


def track(speed: float, frames: int) -> tuple[dict[int, F8], F8]:
    """Boxes of something that moves by `speed`, m a frame, seen from a vehicle that drives 0.5 m a frame."""
    T = pose(np.broadcast_to(np.eye(3), (frames, 3, 3)), np.outer(np.arange(frames), [0.5, 0, 0]))
    return {k: pose(np.eye(3), [20 + (speed - 0.5) * k, 3.0, 0.0]) for k in range(frames)}, T


@pytest.mark.parametrize(
    ("speed", "frames", "expected"),
    [
        (0.051, 60, True),
        (0.049, 60, False),
        (0.0, 60, False),
        (0.1, 6, True),
        (0.04, 6, False),
        (1.0, 1, False),
    ],
)
def test_what_moves_by_its_boxes(speed: float, frames: int, expected: bool) -> None:
    assert moves(*track(speed, frames)) is expected


def seen(number: int, speeds: list[float], **changed: object) -> TrueTracks:
    n = len(speeds)
    zeros = np.zeros(n)
    columns: dict[str, object] = {
        "scan_index": np.arange(n), "instance": np.full(n, number, np.uint16), "what": np.array(["car"] * n, object),
        "class_": np.full(n, PointClass.DYNAMIC, np.uint8), "points": np.ones(n, np.uint32), "x_m": zeros, "y_m": zeros,
        "z_m": zeros, "yaw_rad": zeros, "length_m": zeros, "width_m": zeros, "height_m": zeros,
        "speed_m_s": np.array(speeds),
    }  # fmt: skip
    return TrueTracks(**(columns | changed))


def test_a_car_waits_when_it_is_seen_to_rest_and_to_drive() -> None:
    n = WAITS_SCANS
    tracks = [
        seen(1, [0.0] * n + [5.0]),
        seen(2, [0.0] * (n - 1) + [5.0]),
        seen(3, [0.0] * (n + 5)),
        seen(4, [5.0] * (n + 5)),
        seen(5, [0.0] * n + [5.0], points=np.zeros(n + 1, np.uint32)),
        seen(6, [0.0] * n + [5.0], what=np.array(["bus"] * (n + 1), object)),
    ]
    assert waiting_cars(TrueTracks.concatenate(tracks)) == [1]


FIGURES = [
    Figure("bench.clean.town.scanloom.sa_percent", 98.456, "%", "town", ""),
    Figure("bench.clean.town.scanloom.ms_per_scan", 40.0, "ms", "town", ""),
    Figure("bench.clean.town.dufomap.da_percent", 90.0, "%", "town", ""),
    Figure("bench.clean.town.scanloom.kind_car.sa_percent", 99.0, "%", "town", ""),
    Figure("bench.clean.town.dufomap.kind_car.worst_sa_percent", 97.0, "%", "town", ""),
]


def test_tables_by_scene_and_by_kind() -> None:
    lines = list(tables(FIGURES))
    assert "| town | scanloom | 98.46 |  |  |  |  |  |  |  |  | 40 |" in lines
    assert "| town | dufomap |  | 90.00 |  |  |  |  |  |  |  |  |" in lines
    assert "| town | kind_car | 99.00 |  |  |  |  |  | 97.00 |  |" in lines


def test_a_page_keeps_what_is_around_its_tables(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"above\n{START}\nold\n{END}\nbelow\n")
    fill(page, FIGURES, "measured")
    text = page.read_text()
    assert text.startswith(f"above\n{START}\n") and text.endswith(f"{END}\nbelow\n")
    assert "old" not in text and "measured" in text and "| town |" in text
