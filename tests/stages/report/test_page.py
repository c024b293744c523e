"""Whole pages: what varies from run to run, and the summary of a night."""

from __future__ import annotations

import json
import re
from typing import Any

from scanloom.stages.report.page import fleet_page
from scanloom.stages.report.run import Changed, File, Log, Run, StageTime, run_section
from tests.stages.report.parsing import parse


def test_run_section_shows_times_changed_settings_and_checksums() -> None:
    stages = [StageTime("deskew", 3, 2, 4.0, 310.4), StageTime("odometry", 1, 0)]
    changed = [
        Changed("denoise.dust", "0.5", "0.2", "", "how much <dust>"),
        Changed("odometry.x", "1", "2", "mon"),
    ]
    run = Run(
        stages,
        changed,
        {"scanloom": "0.1.0"},
        [Log("mon", "ab" * 32, 10, 10**9, 2 * 10**9)],
        [File("map.json", "cd" * 32, 77)],
    )
    section = run_section(run)
    text = parse(section).text
    for told in (
        "4.00",
        "310",
        "0.1.0",
        "denoise.dust",
        "how much <dust>",
        "ab" * 32,
        "cd" * 32,
        "1.000",
        "all",
    ):
        assert told in text
    times, memory = (json.loads(part) for part in re.findall(r"json\">(.*?)</script>", section))
    assert times["data"][0]["y"] == memory["data"][0]["y"] == ["deskew"]
    assert (times["data"][0]["x"], memory["data"][0]["x"]) == ([4.0], [310.0])


def test_a_run_that_changed_nothing_says_so_and_many_files_are_counted() -> None:
    text = parse(run_section(Run(files=[File(f"tiles/{k}.parquet", "0", 1) for k in range(151)]))).text
    assert "every setting has its default value" in text
    assert "151 files" in text
    assert "and 1 more, in map.json" in text
    assert "Time and memory" not in text


def test_only_tasks_of_this_run_have_a_time() -> None:
    row = StageTime("deskew").plus(True, 2.0, 100.0).plus(False, 9.0, 900.0).plus(True, 1.0, 50.0)
    assert row == StageTime("deskew", 3, 2, 3.0, 100.0)


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
