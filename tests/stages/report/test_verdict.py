"""The verdict: which figure gives which check."""

from __future__ import annotations

import pytest

from scanloom.schemas.pose_graph import Graph
from scanloom.stages.report.figures import Figures
from scanloom.stages.report.tables import metric_tables
from scanloom.stages.report.verdict import Limits, judge
from tests.metrics import metrics_table
from tests.stages.mapping import session_of


@pytest.mark.parametrize(
    ("name", "session", "value", "text", "level"),
    [
        ("fusion.inter_session_rmse_m", "", 0.02, "within 0.02 m of each other", "pass"),
        ("fusion.inter_session_rmse_m", "", 1.01, "within 1.01 m of each other", "warn"),
        ("fusion.inter_session_rmse_m", "", 10.1, "within 10.10 m of each other", "fail"),
        ("odometry.degenerate_longest_m", "a", 5.0, "over 5 m at the longest", "note"),
        ("odometry.degenerate_longest_m", "a", 4.99, "at the longest", None),
        ("odometry.segments", "a", 3.0, "began anew 2 times", "note"),
        ("odometry.segments", "a", 2.0, "began anew 1 time.", "note"),
        ("gnss.wrong_used", "a", 2.0, "2 GNSS fixes in use are wrong", "warn"),
        ("gnss.wrong_used", "a", 0.0, "are wrong", None),
    ],
)
def test_checks_follow_the_figures(
    name: str, session: str, value: float, text: str, level: str | None
) -> None:
    limits = Limits(0.01, 0.1, 2.0, 10.0, 1.0, 2.0, 500.0)
    metrics = metrics_table([(name, value, session)])
    checks = judge(limits, {"a": session_of()}, Figures(metrics), {}, Graph.empty()).checks
    assert [check.level for check in checks if text in check.text] == ([level] if level else [])


@pytest.mark.parametrize(
    ("share", "patches", "level"),
    [(0.05, 1000.0, "pass"), (0.051, 1000.0, "warn"), (0.3, 1000.0, "warn"), (0.31, 1000.0, "fail"), (0.9, 199.0, None),
     (0.9, 200.0, "fail"), (None, 1000.0, None)],
)  # fmt: skip
def test_double_walls_are_told_when_enough_were_looked_at(
    share: float | None, patches: float, level: str | None
) -> None:
    rows = [("map.wall_patches", patches, ""), ("map.wall_double_gap_median_m", 0.171, "")]
    rows += [] if share is None else [("map.wall_double_share", share, "")]
    limits = Limits(0.01, 0.1, 2.0, 10.0, 1.0, 2.0, 500.0)
    checks = judge(limits, {"a": session_of()}, Figures(metrics_table(rows)), {}, Graph.empty()).checks
    walls = [check for check in checks if check.text.startswith("Walls")]
    assert [check.level for check in walls] == ([level] if level else [])
    if level in ("warn", "fail"):
        assert "17 cm apart" in walls[0].text


def test_what_needs_truth_stands_apart_from_what_does_not() -> None:
    rows = [
        ("odometry.scans", 10.0, "a"), ("odometry.ate_rmse_m", 0.3, "a"), ("fusion.ate_rmse_m", 0.1, "a"),
        ("fusion.path_length_m", 50.0, "a"), ("map.points", 5.0, ""), ("loops.recall", 0.5, ""),
    ]  # fmt: skip
    tables = metric_tables({"a": session_of()}, Figures(metrics_table(rows)))
    shown = {t.title: [p.name for p in t.pairs] + [r.name for r in t.rows] for t in tables}
    assert shown == {
        "Session a, against truth": ["ate_rmse_m"],
        "Session a, without truth": ["path_length_m", "odometry.scans"],
        "Map, against truth": ["loops.recall"],
        "Map, without truth": ["map.points"],
    }
