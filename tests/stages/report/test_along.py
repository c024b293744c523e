"""What the report draws of loops, GNSS, degeneracy and the pose graph."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.changes import Changes
from scanloom.schemas.evaluation import ErrorTrack
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.geometry.factor_rows import fix_rows
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.report.along import SPARE, Blindness, FixTrack, blindness, error_chart, fix_track
from scanloom.stages.report.changed import changed
from scanloom.stages.report.factor_table import factor_rows
from scanloom.stages.report.loop_graph import EDGES, LoopGraph, loop_graph
from scanloom.stages.report.plots import Plot
from scanloom.stages.report.ways import Way, ways
from tests.stages.mapping import fixes_graph, graph_of, loops_of, odometry_of, poses_of, session_of

WORLD = georeference(48.1, 11.6, 520.0).model_dump()


def road(scans: int = 101, step_m: float = 1.0) -> F8:
    T = np.tile(np.eye(4), (scans, 1, 1))
    T[:, 0, 3] = step_m * np.arange(scans)
    return T


def way_of(T: F8) -> Way:
    return ways({"a": poses_of(T)}, {})["a"]


def traces(plot: Plot) -> dict[str, dict[str, Any]]:
    """By name, the first of each."""
    found: dict[str, dict[str, Any]] = {}
    for trace in plot.data:
        found.setdefault(trace.get("name", ""), trace)
    return found


# --- loops ---


def drawn_loops(verdicts: list[str], reasons: list[str], **changed: object) -> LoopGraph:
    """Accepted loops with these verdicts of the graph, then refused ones for these reasons."""
    T = road()
    n, m = len(verdicts), len(reasons)
    loops = loops_of(T, [(k, 50 + k) for k in range(n + m)], [0.0] * (n + m))
    accepted = np.arange(n + m) < n
    loops = replace(loops, accepted=accepted, reason=np.array(["passed"] * n + reasons, object), **changed)
    paths = {"a": poses_of(T), "b": poses_of(T)}
    return loop_graph(paths, ways(paths, {}), loops, graph_of(loops, verdicts))


def test_edges_are_told_apart_by_what_became_of_them() -> None:
    off = "switched off: chi-square 50 above 12"
    session_j = np.array(["b", *["a"] * 5], object)
    found = drawn_loops(["used", "used", off], ["overlap 0.2", "overlap 0.3", "too far"], session_j=session_j)
    assert {edge.kind: edge.count for edge in found.edges} == {
        "refused": 3,
        "doubted": 1,
        "within": 1,
        "between": 1,
    }
    assert found.used == 2
    drawn = [trace["name"] for trace in found.plot.data if trace["mode"] == "lines" and trace["showlegend"]]
    assert sorted(drawn) == sorted(EDGES.values())
    assert [(r.text, r.by, r.count) for r in found.reasons] == [
        ("overlap …", "tests", 2),
        ("too far", "tests", 1),
        ("switched off: chi-square … above …", "graph", 1),
    ]
    assert found.other_reasons == 0


def test_an_edge_leads_from_one_place_to_the_other_and_tells_of_both() -> None:
    found = drawn_loops(["used"], ["overlap <0.2>"])
    line = traces(found.plot)["in use"]
    assert line["x"] == [0.0, 50.0, None]
    assert line["y"] == [0.0, 0.0, None]
    dots = [trace for trace in found.plot.data if trace["mode"] == "markers"]
    assert dots[1]["text"][0] == "scans 0 and 50, rmse 0.05 m, overlap 80 %"
    assert dots[0]["text"][0].endswith("overlap &lt;0.2&gt;")
    assert [(pair.scans, pair.outcome) for pair in found.pairs] == [
        ("scans 0 and 50", "in use"),
        ("scans 1 and 51", "overlap <0.2>"),
    ]


def test_reasons_beyond_the_first_few_are_counted_together() -> None:
    found = drawn_loops([], [f"reason {chr(97 + k)}" for k in range(12)])
    assert len(found.reasons) == 8
    assert found.other_reasons == 4
    assert found.used == 0


def test_thousands_of_edges_stay_a_small_picture() -> None:
    T = road(6000, 0.1)
    loops = loops_of(T, [(k, 3000 + k) for k in range(3000)], [0.0] * 3000)
    paths = {"a": poses_of(T)}
    found = loop_graph(paths, ways(paths, {}), loops, graph_of(loops))
    assert found.used == 3000
    assert 3 * 300 <= len(traces(found.plot)["in use"]["x"]) <= 3 * 600
    assert len(found.plot.json) < 250_000
    assert len(found.pairs) == 60


def test_no_loops_and_loops_without_poses_draw_nothing() -> None:
    T = road()
    paths = {"a": poses_of(T)}
    nothing = loop_graph(paths, ways(paths, {}), Loops.empty(), Graph.empty())
    assert not nothing.plot
    assert (nothing.edges, nothing.reasons, nothing.pairs) == ([], [], [])
    loops = loops_of(T, [(0, 50)], [0.0], session="elsewhere")
    found = loop_graph(paths, ways(paths, {}), loops, graph_of(loops))
    assert not found.plot
    assert found.used == 1
    nowhere = {"elsewhere": Poses.empty(frame="map", georeference=None)}
    assert not loop_graph(nowhere, ways(nowhere, {}), loops, graph_of(loops)).plot


# --- GNSS ---


def track_of(off_m: F8, verdicts: list[str], georeference: dict[str, object] | None = WORLD) -> FixTrack:
    T = road(len(off_m))
    graph = fixes_graph(T[:, :3, 3] + np.nan_to_num(off_m), -off_m, verdicts)
    return fix_track("a", fix_rows(graph)["a"], way_of(T), georeference is not None)


def test_fixes_are_coloured_by_what_became_of_them() -> None:
    off = np.zeros((6, 3))
    off[:, 0] = [0.01, 0.1, 1.0, 10.0, 10.0, np.nan]
    verdicts = [
        "used",
        SPARE,
        "lies by 3 m",
        "lies by 4 m",
        "switched off: chi-square 99",
        "receiver reports no fix",
    ]
    found = track_of(off, verdicts)
    assert [(v.text, v.count, v.kind) for v in found.verdicts] == [
        (SPARE, 1, "spare"),
        ("used", 1, "used"),
        ("lies by … m", 2, "gate"),
        ("switched off: chi-square …", 1, "off"),
        ("receiver reports no fix", 1, "none"),
    ]
    dots = traces(found.plot)
    assert (dots["used"]["x"], dots["used"]["y"]) == ([0.0], [0.01])
    assert (dots["left out by a test"]["x"], dots["left out by a test"]["y"]) == ([2.0, 3.0], [1.0, 10.0])
    assert dots["switched off: contradicts the rest of the graph"]["x"] == [4.0]
    assert (dots["used"]["customdata"], dots["used"]["meta"]) == ([[0, 0.0]], {"start_s": 1_700_000_000.0})


def test_stretches_without_a_position_are_marked() -> None:
    off = np.zeros((11, 3))
    T = road(11)
    graph = fixes_graph(T[:, :3, 3], off, ["used"] * 11)
    measurement = graph.measurement.copy()
    measurement[4:7, :3, 3] = np.nan
    residual = graph.residual_m.copy()
    residual[4:7] = np.nan
    rows = fix_rows(replace(graph, measurement=measurement, residual_m=residual))["a"]
    (band,) = fix_track("a", rows, way_of(T), True).plot.layout["shapes"]
    assert (band["x0"], band["x1"], band["fillcolor"]) == (3.0, 6.0, "--band-quiet")


def test_without_a_georeference_verdicts_are_listed_and_nothing_is_drawn() -> None:
    found = track_of(np.ones((4, 3)), ["too few good fixes"] * 4, None)
    assert not found.plot
    assert found.verdicts[0].count == 4


def test_fixes_on_the_other_side_of_the_earth_have_their_place() -> None:
    drawn = track_of(np.full((3, 3), 9e6), ["used", "off", "off"]).plot
    low, high = drawn.layout["yaxis"]["range"]
    assert low < np.log10(9e6 * np.sqrt(2)) < high
    assert "NaN" not in drawn.json


def test_hours_of_fixes_stay_a_small_picture() -> None:
    off = np.abs(np.random.default_rng(0).normal(size=(40_000, 3)))
    drawn = track_of(off, ["used", SPARE, "lies", "switched off"] * 10_000).plot
    assert [len(trace["x"]) for trace in drawn.data] == [2000] * 4
    assert len(drawn.json) < 400_000


# --- degeneracy ---


def blind_road(scans: int = 101) -> Odometry:
    p = np.ones((scans, 6))
    p[21:41, 3] = 0.1
    p[31:51, 2] = 0.1
    return replace(odometry_of(road(scans)), direction_p=p)


def blind_of(odometry: Odometry) -> Blindness:
    return blindness("a", odometry, session_of(), way_of(road(max(len(odometry), 1))))


def test_blind_stretches_are_marked_and_named() -> None:
    found = blind_of(blind_road())
    assert found.share == pytest.approx(30 / 101)
    assert found.longest_m == pytest.approx(30.0)
    (band,) = found.plot.layout["shapes"]
    assert (band["x0"], band["x1"]) == (20.0, 50.0)
    assert found.plot.layout["yaxis2"]["ticktext"] == ["along", "across", "up", "turn"]
    rows = [trace["x"] for trace in found.plot.data if trace.get("yaxis") == "y2"]
    assert rows == [[20.0, 40.0, None], [], [], [30.0, 50.0, None]]


def test_a_way_that_was_seen_has_a_curve_and_no_bands() -> None:
    found = blind_of(odometry_of(road()))
    assert found.share == found.longest_m == 0.0
    assert [trace["mode"] for trace in found.plot.data] == ["lines"]
    assert found.plot.layout["shapes"] == []
    assert "yaxis2" not in found.plot.layout


@pytest.mark.parametrize("scans", [0, 1])
def test_no_way_has_no_chart(scans: int) -> None:
    assert not blind_of(odometry_of(road(scans))).plot


def test_scans_without_e1_leave_a_gap_and_all_of_them_no_chart() -> None:
    odometry = odometry_of(road())
    e1 = odometry.degeneracy_e.copy()
    e1[10:20] = np.nan
    drawn = blind_of(replace(odometry, degeneracy_e=e1)).plot.data[0]
    assert [k for k, v in enumerate(drawn["y"]) if v is None] == list(range(9, 19))
    assert not blind_of(replace(odometry, degeneracy_e=np.full(101, np.nan))).plot


# --- errors ---


def test_errors_lie_where_their_scans_were() -> None:
    T = road(11, 2.0)
    stamps = poses_of(T).stamp_ns[3:6]
    track = ErrorTrack(
        stamp_ns=stamps, travelled_m=np.arange(3.0), odometry_error_m=np.array([1.0, 2.0, 3.0]), fusion_error_m=np.full(3, 0.5)
    )  # fmt: skip
    odometry, fused = error_chart("a", track, way_of(T)).data
    assert odometry["x"] == fused["x"] == [6.0, 8.0, 10.0]
    assert odometry["y"] == [1.0, 2.0, 3.0]
    assert [scan for scan, _ in fused["customdata"]] == [3, 4, 5]


def test_a_session_that_is_not_in_the_map_is_shown_by_its_odometry() -> None:
    paths, T = {"a": poses_of(road(11))}, road(21, 3.0)
    on_way = ways(paths, {"a": odometry_of(road(11)), "b": odometry_of(T)})
    assert list(on_way) == ["a", "b"]
    assert (on_way["a"].length_m, on_way["b"].length_m) == (10.0, 60.0)
    assert not blindness("b", odometry_of(T), session_of("b"), on_way["b"]).longest_m
    assert ways({"a": Poses.empty(frame="map", georeference=None)}, {}) == {}


def test_many_sessions_share_the_points_of_their_curves() -> None:
    many = ways({f"s{k}": poses_of(road(5000)) for k in range(6)}, {})
    odometry = replace(
        odometry_of(road(5000)), degeneracy_e=np.random.default_rng(0).uniform(0.01, 0.02, 5000)
    )
    drawn = blindness("s0", odometry, session_of(), many["s0"]).plot.data[0]
    assert 900 <= len(drawn["x"]) <= 1000


# --- pose graph ---


def test_factors_are_counted_kind_by_kind_with_the_residuals_of_those_in_use() -> None:
    loops = loops_of(road(), [(k, 50 + k) for k in range(4)], [0.0] * 4)
    graph = graph_of(loops, ["used", "used", "used", "wrong"])
    graph = replace(graph, residual_after=np.array([1.0, 2.0, 3.0, 900.0]))
    fixes = fixes_graph(np.zeros((2, 3)), np.zeros((2, 3)), ["no fix", "no fix"])
    gnss, loop = sorted(factor_rows(Graph.concatenate([fixes, graph])), key=lambda row: row.kind)
    assert (loop.kind, loop.count, loop.used, loop.before, loop.after) == ("loop", 4, 3, "2 / 2", "2 / 2.9")
    assert (gnss.count, gnss.used, gnss.before, gnss.after) == (2, 0, "–", "–")
    assert factor_rows(Graph.empty()) == []


# --- changes ---


def changes_of(objects: list[tuple[float, float, int]], sessions: tuple[str, ...] = ("b",)) -> Changes:
    """Objects as cubes of a metre with so many points at (x, y), mixed with each other."""
    rng = np.random.default_rng(0)
    number = rng.permutation(np.repeat(np.arange(len(objects)), [n for *_, n in objects])).astype(np.int32)
    middle = np.array([(x, y, 0.0) for x, y, _ in objects]).reshape(-1, 3)[number]
    xyz = middle + rng.uniform(-0.5, 0.5, middle.shape)
    n = len(number)
    return Changes(
        x_m=xyz[:, 0].copy(), y_m=xyz[:, 1].copy(), z_m=xyz[:, 2].copy(), through=np.full(n, 7, np.int32),
        confirming=np.zeros(n, np.int32), object_=number, remnants=31, sessions=sessions, frame="map", georeference=None,
    )  # fmt: skip


def test_what_is_gone_is_listed_the_largest_first_and_drawn() -> None:
    found = changed({"a": way_of(road())}, changes_of([(10.0, 5.0, 40), (60.0, -5.0, 90)]))
    assert found is not None
    assert (found.objects, found.points) == (2, 130)
    assert [gone.points for gone in found.listed] == [90, 40]
    assert found.listed[0].middle_m == pytest.approx((60.0, -5.0, 0.0), abs=0.1)
    assert found.listed[0].size_m == pytest.approx((1.0, 1.0, 1.0), abs=0.1)
    assert found.listed[0].through == 7
    assert found.plot.data[-1]["x"] == pytest.approx([60.0, 10.0], abs=0.1)


def test_more_objects_than_a_list_has_room_for_are_all_drawn() -> None:
    found = changed({"a": way_of(road())}, changes_of([(5.0 * k, 3.0, 10) for k in range(20)]))
    assert found is not None
    assert len(found.listed) == 12
    assert len(found.plot.data[-1]["x"]) == 20


def test_nothing_gone_and_nothing_extended_are_two_things() -> None:
    paths = {"a": way_of(road())}
    assert changed(paths, None) is None
    assert changed(paths, changes_of([], ())) is None
    looked = changed(paths, changes_of([]))
    assert looked is not None
    assert (looked.objects, bool(looked.plot), looked.listed) == (0, False, [])
    nowhere = changed({}, changes_of([(1.0, 1.0, 9)]))
    assert nowhere is not None
    assert not nowhere.plot
