"""Whole pages: what varies from run to run, and the summary of a night."""

from __future__ import annotations

from typing import Any

from scanloom.stages.report.page import fleet_page, run_section
from tests.stages.report.parsing import parse


def test_run_section_shows_times_and_provenance() -> None:
    rows = [
        {"stage": "deskew", "tasks": 3, "executed": 2, "wall_s": 4.0, "peak_rss_mb": 310.4},
        {"stage": "odometry", "tasks": 1, "executed": 0, "wall_s": 0.0, "peak_rss_mb": 0.0},
    ]
    section = run_section(rows, {"scanloom": "0.1.0"})
    text = parse(section).text
    assert "width: 100.0%" in section
    assert "4.00" in text
    assert "310" in text
    assert "0.1.0" in text


def metric(name: str, value: float, previous: float | None, session: str = "") -> dict[str, Any]:
    return {
        "name": name,
        "value": value,
        "unit": "",
        "scope": "map",
        "session": session,
        "previous": previous,
    }


def test_fleet_page_shows_changes_failures_and_links() -> None:
    rows = [
        {
            "map": "harbour", "sessions": ["mon", "tue"], "delivered": True, "report": "maps/harbour/report.html",
            "new": False, "warnings": ["tue: clock jumps"], "failures": [],
            "metrics": [
                metric("fusion.ate_rmse_m", 0.2, 0.3, "mon"), metric("fusion.ate_rmse_m", 0.4, 0.3, "tue"),
                metric("map.points", 2000.0, 1000.0),
            ],
        },
        {
            "map": "depot", "sessions": ["x.bag"], "delivered": False, "report": None, "new": True, "warnings": [],
            "failures": ["x.bag: holds no 3D LiDAR"], "metrics": [],
        },
    ]  # fmt: skip
    page = fleet_page(rows, made="today")
    parser = parse(page)
    assert parser.addresses == ["maps/harbour/report.html"]
    assert page.count('class="change better"') == 1
    assert page.count('class="change worse"') == 1
    assert page.count('class="change soft"') == 1
    assert "x.bag: holds no 3D LiDAR" in parser.text
    assert "clock jumps" in parser.text
    assert "1 of 2" in parser.text
    parse(fleet_page([], made="today"))
