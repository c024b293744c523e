"""The verdict: which figure gives which check."""

from __future__ import annotations

import pytest

from scanloom.schemas.pose_graph import Graph
from scanloom.stages.report.figures import Figures
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
