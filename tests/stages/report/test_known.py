"""What is known of each scan, what moved, the verdict in a sentence, and the three pictures of a map."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.objects import ObjectClass, ObjectTracks
from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.factor_rows import fix_rows
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.report.figures import Figures
from scanloom.stages.report.known import Known, quantities, share_percent, speed_m_s
from scanloom.stages.report.moving import moving, share_chart
from scanloom.stages.report.plan import track_plan
from scanloom.stages.report.raster import BACKGROUND, CLASS_COLOURS, View, draw_map
from scanloom.stages.report.sentence import evidence, sentence
from scanloom.stages.report.verdict import Check, Verdict
from scanloom.stages.report.ways import Way, ways
from tests.metrics import metrics_table
from tests.stages.mapping import fixes_graph, odometry_of, poses_of, stamps
from tests.stages.report.test_along import road
from tests.tiles import tile_of


def known_of(T: F8, **more: Any) -> tuple[dict[str, Way], Known]:
    poses = {"a": poses_of(T)}
    return ways(poses, {}), Known(poses, **more)


def values_of(T: F8, key: str, **more: Any) -> F8:
    found = {quantity.key: quantity.values["a"] for quantity in quantities(*known_of(T, **more))}
    return found[key]


# --- quantities ---


def test_only_what_is_known_can_be_chosen() -> None:
    assert [q.key for q in quantities(*known_of(road()))] == ["sigma", "speed", "height"]
    both = quantities(*known_of(road(), odometry={"a": odometry_of(road())}))
    assert [(q.key, q.worse) for q in both] == [
        ("e1", True), ("sigma", True), ("speed", False), ("height", False)
    ]  # fmt: skip


@pytest.mark.parametrize("step_m", [0.0, 0.5, 2.0])
def test_speed_is_distance_over_time_from_the_first_scan_to_the_last(step_m: float) -> None:
    way = ways({"a": poses_of(road(50, step_m))}, {})["a"]
    assert speed_m_s(way) == pytest.approx(np.full(50, 10 * step_m))


def test_one_scan_has_no_speed() -> None:
    assert np.isnan(speed_m_s(ways({"a": poses_of(road(1))}, {})["a"])).all()


def test_the_deviation_of_a_pose_sums_its_three_variances() -> None:
    assert values_of(road(5), "sigma") == pytest.approx(np.full(5, np.sqrt(3e-4)))


def test_a_scan_has_the_residual_of_the_fix_nearest_along_the_way_unless_none_is_near() -> None:
    T = road(101)
    off = np.full((101, 3), np.nan)
    off[10], off[50] = (3.0, 4.0, 9.0), (0.0, 1.0, 0.0)
    graph = fixes_graph(T[:, :3, 3], -off, ["used"] * 101)
    found = values_of(T, "fix", fixes={"a": fix_rows(graph)["a"]})
    assert found[[0, 10, 30, 31, 50, 80]] == pytest.approx([5, 5, 5, 1, 1, 1])
    assert np.isnan(found[81:]).all()


def counts_of(scans: int, **classes: int) -> ClassCounts:
    points = np.zeros((scans, len(PointClass)), np.int64)
    for name, count in classes.items():
        points[:, int(PointClass[name])] = count
    return ClassCounts(scan_index=np.arange(scans), points=points, before=points)


def test_shares_are_of_what_a_map_could_take() -> None:
    counts = counts_of(3, STATIC=60, DYNAMIC=30, AIRBORNE=10, EGO=500, OUT_OF_RANGE=400)
    assert share_percent(counts.points, PointClass.DYNAMIC) == pytest.approx([30.0] * 3)
    assert values_of(road(3), "out", counts={"a": counts}) == pytest.approx([40.0] * 3)
    assert share_percent(counts_of(2, EGO=5).points, PointClass.DYNAMIC).tolist() == [0.0, 0.0]


def test_tracks_of_a_crowd_of_sessions_stay_a_small_figure() -> None:
    poses = {f"s{k:02d}": poses_of(road(5000)) for k in range(30)}
    on_way = ways(poses, {})
    plot = track_plan(on_way, quantities(on_way, Known(poses)), [])
    assert sum(len(plot.data[k]["x"]) for k in plot.more["beads"].values()) == 2400
    assert len(plot.json) < 500_000
    colour = plot.more["colours"][-1]
    assert [len(values) for values in colour["values"].values()] == [80] * 30


# --- what moved ---


def tracks_of(rows: list[tuple[int, int, float, ObjectClass, bool]], y_m: float = 3.0) -> ObjectTracks:
    """Rows of (track, scan, speed, class, dynamic), `y_m` to the left of the LiDAR."""
    track, scan, speed, class_, dynamic = (np.array(column) for column in zip(*rows))
    n = len(rows)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 1, 3] = y_m
    one = np.ones(n)
    return ObjectTracks(
        scan_index=scan, stamp_ns=stamps(200)[scan], track=track.astype(np.int32), T_odom_object=T, T_lidar_object=T,
        length_m=4 * one, width_m=2 * one, height_m=one, speed_m_s=speed, class_=class_.astype(np.uint8), dynamic=dynamic,
        score=one,
    )  # fmt: skip


def test_moving_things_are_counted_by_track_and_drawn_where_they_were() -> None:
    car, person = ObjectClass.VEHICLE, ObjectClass.PERSON
    rows = [(0, k, 10.0, car, True) for k in range(10)] + [(1, k, 2.0, car, True) for k in range(5)]
    rows += [(2, k, 1.0, person, True) for k in range(3)] + [(3, 0, 0.0, car, False)]
    paths = {"a": poses_of(road(20))}
    found = moving({"a": tracks_of(rows)}, paths, ways(paths, {}))
    assert found.tracks == 3
    assert [(row.words, row.tracks) for row in found.rows] == [("cars", 2), ("people", 1)]
    assert (found.rows[0].median_m_s, found.rows[0].fastest_m_s) == (6.0, 10.0)
    assert found.rows[0].followed_s == pytest.approx(0.65)
    cars = next(trace for trace in found.plot.data if trace["name"] == "cars")
    assert cars["x"] == [*range(10), None, *range(5), None]
    assert {y for y in cars["y"] if y is not None} == {3.0}


def test_nothing_that_moves_is_no_figure() -> None:
    paths = {"a": poses_of(road(5))}
    still = tracks_of([(0, 0, 0.0, ObjectClass.VEHICLE, False)])
    found = moving({"a": still}, paths, ways(paths, {}))
    assert (found.rows, bool(found.plot), found.tracks) == ([], False, 0)
    assert not moving({}, paths, ways(paths, {})).plot


def test_shares_along_the_way_have_a_curve_for_each_class_that_occurs() -> None:
    way = ways({"a": poses_of(road(4))}, {})["a"]
    plot = share_chart("a", counts_of(4, STATIC=90, AIRBORNE=10), way)
    assert [trace["y"] for trace in plot.data] == [[10.0] * 4]
    assert not share_chart("a", counts_of(4, STATIC=90), way)


# --- the sentence ---


def test_the_sentence_names_the_worst_or_what_speaks_for_the_map() -> None:
    fine, odd, bad = (
        Check("pass", "All is well."),
        Check("warn", "Walls are double."),
        Check("fail", "No points."),
    )
    assert (
        sentence(Verdict("Good", "pass", [fine]))
        == "This map can be relied on: no check warns; 1 check passed."
    )
    told = ["its trajectory lies within 0.30 m of truth", "2 loops hold it together"]
    assert sentence(Verdict("Good", "note", [fine]), told).endswith(
        f"no check warns; {told[0]} and {told[1]}."
    )
    assert (
        sentence(Verdict("Fair", "warn", [odd, fine]), told)
        == "This map is usable with care: Walls are double."
    )
    worst = sentence(Verdict("Poor", "fail", [bad, bad, odd]))
    assert worst == "Do not rely on this map as it is: No points (1 more like this below)."


def test_evidence_is_the_worst_of_all_sessions() -> None:
    rows = [("fusion.ate_rmse_m", 0.1, "a"), ("fusion.ate_rmse_m", 0.304, "b"), ("loops.accepted", 1.0, "")]
    assert evidence(["a", "b"], Figures(metrics_table(rows)), [0.2, 0.5]) == [
        "its trajectory lies within 0.30 m of truth", "it agrees with GNSS to 0.50 m", "1 loop holds it together"
    ]  # fmt: skip
    assert evidence(["a"], Figures(metrics_table([])), []) == []


# --- pictures ---


def test_three_pictures_of_one_view_are_filled_at_the_same_places() -> None:
    places = np.array([[5.2, 5.2, 0.0], [5.2, 5.2, 4.0], [15.2, 5.2, 0.0]])
    tile = tile_of(places, class_=int(PointClass.GROUND))
    tile.class_[tile.z_m > 1] = PointClass.STATIC
    drawn = draw_map([tile], View(0.0, 0.0, 40, 20, 0.5))
    pictures = (drawn.height, drawn.intensity, drawn.classes)
    filled = [(picture != np.array(BACKGROUND)).any(axis=2) for picture in pictures]
    assert all(np.array_equal(filled[0], other) for other in filled)
    assert filled[0].sum() == 2
    # The higher of two points over each other is the one that is seen.
    assert tuple(drawn.classes[9, 10]) == CLASS_COLOURS[PointClass.STATIC]
    assert tuple(drawn.classes[9, 30]) == CLASS_COLOURS[PointClass.GROUND]


def test_a_map_without_points_is_dark_in_all_three() -> None:
    drawn = draw_map([], View(0.0, 0.0, 20, 16, 0.5))
    for picture in (drawn.height, drawn.intensity, drawn.classes):
        assert (picture == np.array(BACKGROUND)).all()


def test_the_picture_in_colour_shows_what_cameras_saw() -> None:
    places = np.array([[5.2, 5.2, 0.0], [5.2, 5.2, 4.0], [15.2, 5.2, 0.0]])
    blind = tile_of(places)
    assert draw_map([blind], View(0.0, 0.0, 40, 20, 0.5)).colour is None
    tile = tile_of(places)
    tile.colour[tile.z_m < 1], tile.views[tile.z_m < 1] = (200, 10, 60), 1
    tile.colour[tile.x_m > 9], tile.views[tile.x_m > 9] = 0, 0
    drawn = draw_map([tile], View(0.0, 0.0, 40, 20, 0.5)).colour
    assert drawn is not None
    # What stands over it was seen by none and does not hide it.
    red, green, blue = drawn[9, 10].tolist()
    assert red > 90 and red > 10 * green and 2.5 < red / blue < 4.5
    assert max(drawn[9, 30]) < 70 and tuple(drawn[0, 0]) == BACKGROUND
