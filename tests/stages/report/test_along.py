"""What the report draws of loops, GNSS, degeneracy and the pose graph."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from scanloom.schemas.changes import Changes
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.geometry.factor_rows import fix_rows
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.report.along import SPARE, FixTrack, blindness, fix_track
from scanloom.stages.report.changed import changed
from scanloom.stages.report.factor_table import factor_rows
from scanloom.stages.report.loop_graph import LoopGraph, loop_graph
from tests.stages.mapping import fixes_graph, graph_of, loops_of, odometry_of, poses_of, session_of

WORLD = georeference(48.1, 11.6, 520.0).model_dump()


def road(scans: int = 101, step_m: float = 1.0) -> F8:
    T = np.tile(np.eye(4), (scans, 1, 1))
    T[:, 0, 3] = step_m * np.arange(scans)
    return T


# --- loops ---


def drawn_loops(verdicts: list[str], reasons: list[str], **changed: object) -> LoopGraph:
    """Accepted loops with these verdicts of the graph, then refused ones for these reasons."""
    T = road()
    n, m = len(verdicts), len(reasons)
    loops = loops_of(T, [(k, 50 + k) for k in range(n + m)], [0.0] * (n + m))
    accepted = np.arange(n + m) < n
    loops = replace(loops, accepted=accepted, reason=np.array(["passed"] * n + reasons, object), **changed)
    return loop_graph({"a": poses_of(T), "b": poses_of(T)}, loops, graph_of(loops, verdicts))


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
    for kind in ("refused", "doubted", "within", "between"):
        assert found.svg.count(f'class="edge edge-{kind}"') == 1
    assert [(r.text, r.by, r.count) for r in found.reasons] == [
        ("overlap …", "tests", 2),
        ("too far", "tests", 1),
        ("switched off: chi-square … above …", "graph", 1),
    ]
    assert found.other_reasons == 0


def test_an_edge_leads_from_one_place_to_the_other() -> None:
    found = drawn_loops(["used"], [])
    (edge,) = re.findall(r'd="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)" class="edge', found.svg)
    (bar,) = re.findall(r'd="M[\d.]+ [\d.]+v8h([\d.]+)v-8" class="bar-line"', found.svg)
    x_i, y_i, x_j, y_j = map(float, edge)
    assert y_i == y_j
    assert found.scale == "20 m"
    assert (x_j - x_i) / float(bar) == pytest.approx(50 / 20, rel=1e-3)


def test_reasons_beyond_the_first_few_are_counted_together() -> None:
    found = drawn_loops([], [f"reason {chr(97 + k)}" for k in range(12)])
    assert len(found.reasons) == 8
    assert found.other_reasons == 4
    assert found.used == 0


def test_thousands_of_edges_stay_a_small_picture() -> None:
    T = road(6000, 0.1)
    loops = loops_of(T, [(k, 3000 + k) for k in range(3000)], [0.0] * 3000)
    found = loop_graph({"a": poses_of(T)}, loops, graph_of(loops))
    assert found.used == 3000
    assert 300 <= found.svg.count("L") <= 600
    assert len(found.svg) < 120_000


def test_no_loops_and_loops_without_poses_draw_nothing() -> None:
    T = road()
    assert loop_graph({"a": poses_of(T)}, Loops.empty(), Graph.empty()) == LoopGraph("", "", [], [], 0)
    loops = loops_of(T, [(0, 50)], [0.0], session="elsewhere")
    found = loop_graph({"a": poses_of(T)}, loops, graph_of(loops))
    assert found.svg == ""
    assert found.used == 1
    nowhere = Poses.empty(frame="map", georeference=None)
    assert loop_graph({"elsewhere": nowhere}, loops, graph_of(loops)).svg == ""


# --- GNSS ---


def track_of(off_m: F8, verdicts: list[str], georeference: dict[str, object] | None = WORLD) -> FixTrack:
    T = road(len(off_m))
    graph = fixes_graph(T[:, :3, 3] + np.nan_to_num(off_m), -off_m, verdicts)
    return fix_track(fix_rows(graph)["a"], poses_of(T, georeference=georeference))


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
    # Five decades of which the first is 1 mm: 1 cm is a quarter of the height, at the bottom of the picture.
    assert 'd="M0.0 150.0h0" class="dots dots-used"' in found.chart
    assert 'd="M400.0 50.0h0M600.0 0.0h0" class="dots dots-gate"' in found.chart
    assert 'd="M800.0 0.0h0" class="dots dots-off"' in found.chart


def test_stretches_without_a_position_are_marked() -> None:
    off = np.zeros((11, 3))
    T = road(11)
    graph = fixes_graph(T[:, :3, 3], off, ["used"] * 11)
    measurement = graph.measurement.copy()
    measurement[4:7, :3, 3] = np.nan
    residual = graph.residual_m.copy()
    residual[4:7] = np.nan
    rows = fix_rows(replace(graph, measurement=measurement, residual_m=residual))["a"]
    drawn = fix_track(rows, poses_of(T, georeference=WORLD)).chart
    assert 'd="M300.0 0H600.0V200H300.0z" class="band band-quiet"' in drawn


def test_without_a_georeference_verdicts_are_listed_and_nothing_is_drawn() -> None:
    found = track_of(np.ones((4, 3)), ["too few good fixes"] * 4, None)
    assert found.chart == ""
    assert found.verdicts[0].count == 4


def test_fixes_on_the_other_side_of_the_earth_have_their_place() -> None:
    drawn = track_of(np.full((3, 3), 9e6), ["used", "off", "off"]).chart
    assert "1e+07" in drawn
    assert "nan" not in drawn


def test_hours_of_fixes_stay_a_small_picture() -> None:
    off = np.abs(np.random.default_rng(0).normal(size=(40_000, 3)))
    assert len(track_of(off, ["used", SPARE, "lies", "switched off"] * 10_000).chart) < 60_000


# --- degeneracy ---


def blind_road(scans: int = 101) -> Odometry:
    p = np.ones((scans, 6))
    p[21:41, 3] = 0.1
    p[31:51, 2] = 0.1
    return replace(odometry_of(road(scans)), direction_p=p)


def test_blind_stretches_are_marked_and_named() -> None:
    found = blindness(blind_road(), session_of())
    assert found.share == pytest.approx(30 / 101)
    assert found.longest_m == pytest.approx(30.0)
    assert "M200.0 0H500.0V200" in found.chart
    rows = found.chart.split('<span class="row">')[1:]
    assert [row.split("<")[0] for row in rows] == ["along", "across", "up", "turn"]
    assert "M200.0 0H400.0V10" in rows[0]
    assert "strip-blind" not in rows[1] + rows[2]
    assert "M300.0 0H500.0V10" in rows[3]


def test_a_way_that_was_seen_has_a_curve_and_no_bands() -> None:
    found = blindness(odometry_of(road()), session_of())
    assert found.share == found.longest_m == 0.0
    assert "curve-1" in found.chart
    assert "band" not in found.chart


@pytest.mark.parametrize("scans", [0, 1])
def test_no_way_has_no_chart(scans: int) -> None:
    assert blindness(odometry_of(road(scans)), session_of()).chart == ""


def test_scans_without_e1_leave_a_gap_and_all_of_them_no_chart() -> None:
    odometry = odometry_of(road())
    e1 = odometry.degeneracy_e.copy()
    e1[10:20] = np.nan
    assert "nan" not in blindness(replace(odometry, degeneracy_e=e1), session_of()).chart
    assert blindness(replace(odometry, degeneracy_e=np.full(101, np.nan)), session_of()).chart == ""


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
    found = changed({"a": poses_of(road())}, changes_of([(10.0, 5.0, 40), (60.0, -5.0, 90)]))
    assert found is not None
    assert (found.objects, found.points) == (2, 130)
    assert [gone.points for gone in found.listed] == [90, 40]
    assert found.listed[0].middle_m == pytest.approx((60.0, -5.0, 0.0), abs=0.1)
    assert found.listed[0].size_m == pytest.approx((1.0, 1.0, 1.0), abs=0.1)
    assert found.listed[0].through == 7
    assert found.svg.count("h0") == 2


def test_more_objects_than_a_list_has_room_for_are_all_drawn() -> None:
    found = changed({"a": poses_of(road())}, changes_of([(5.0 * k, 3.0, 10) for k in range(20)]))
    assert found is not None
    assert len(found.listed) == 12
    assert found.svg.count("h0") == 20


def test_nothing_gone_and_nothing_extended_are_two_things() -> None:
    paths = {"a": poses_of(road())}
    assert changed(paths, None) is None
    assert changed(paths, changes_of([], ())) is None
    looked = changed(paths, changes_of([]))
    assert looked is not None
    assert (looked.objects, looked.svg, looked.listed) == (0, "", [])
    nowhere = Poses.empty(frame="map", georeference=None)
    assert getattr(changed({"a": nowhere}, changes_of([(1.0, 1.0, 9)])), "svg", None) == ""
