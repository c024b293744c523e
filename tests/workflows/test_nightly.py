"""A night of ten logs of which one is bad."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from scanloom.workflows.nightly import run_fleet, with_changes
from tests.logs import scan_folder


def test_one_bad_log_of_ten(tmp_path: Path) -> None:
    scan_folder(tmp_path / "logs/drive-0", count=6)
    for i in range(1, 9):
        shutil.copytree(tmp_path / "logs/drive-0", tmp_path / f"logs/drive-{i}")
        (tmp_path / f"logs/drive-{i}/000005.bin").unlink()
        (tmp_path / f"logs/drive-{i}/{i + 5:06d}.bin").write_bytes(
            (tmp_path / "logs/drive-0/000005.bin").read_bytes()
        )
    (tmp_path / "logs/drive-9.bag").write_text("no log\n")
    fleet = tmp_path / "fleet.yaml"
    fleet.write_text("each: ['logs/*']\nout: night\n")

    first = run_fleet(fleet, None, tmp_path / "store", cluster="none")
    assert first.exit_code == 3
    rows = first.summary["maps"]
    assert [row["delivered"] for row in rows] == [True] * 9 + [False]
    assert len(first.failures) == 1 and "drive-9.bag" in first.failures[0]
    page = first.page.read_text()
    assert all(row["map"] in page for row in rows) and "drive-9.bag" in page

    shutil.rmtree(tmp_path / "logs/drive-8")
    second = run_fleet(fleet, None, tmp_path / "store", cluster="none")
    assert len(second.summary["maps"]) == 9
    assert sum(row["executed"] for row in second.summary["maps"]) == 0
    assert json.loads((tmp_path / "night/summary.json").read_text()) == second.summary


def test_change_since_last_night() -> None:
    tonight = [
        {"map": "a", "metrics": [{"name": "m", "value": 2.0}]},
        {"map": "b", "metrics": [{"name": "m", "value": 1.0}]},
    ]
    before = [{"map": "a", "metrics": [{"name": "m", "value": 1.5}]}]
    rows = with_changes(tonight, before)
    assert rows[0]["metrics"][0]["previous"] == 1.5 and not rows[0]["new"]
    assert rows[1]["metrics"][0]["previous"] is None and rows[1]["new"]
