"""A night of ten logs of which one is bad."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from scanloom.workflows.nightly import Night, run_fleet, with_changes
from scanloom.workflows.noise import measured
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


def test_the_gate_stops_a_map_that_is_worse_than_last_night(tmp_path: Path) -> None:
    scan_folder(tmp_path / "logs/drive", count=6)
    fleet = tmp_path / "fleet.yaml"
    fleet.write_text("each: ['logs/*']\ngate: true\n")

    def night() -> Night:
        return run_fleet(fleet, None, tmp_path / "store", cluster="none")

    assert night().exit_code == 0  # there is nothing to be worse than
    metrics = tmp_path / "night/maps/drive/metrics.json"
    rows = json.loads(metrics.read_text())
    (entropy,) = [row for row in rows if row["name"] == "map.mme_r0.5_nat"]
    entropy["value"] -= 0.05
    metrics.write_text(json.dumps(rows))
    worse = night()
    assert worse.exit_code == 5
    (text,) = worse.regressions
    assert text.startswith("drive: regression: map.mme_r0.5_nat")
    assert "regression: map.mme_r0.5_nat" in worse.page.read_text()
    assert night().exit_code == 0  # the worse map is what the next is held against

    noise = measured([("", [{"name": "map.mme_r0.5_nat", "value": v}]) for v in (1.0, 1.1, 1.2)])
    noise.write(tmp_path / "noise.json")
    fleet.write_text("each: ['logs/*']\ngate: true\nnoise: noise.json\n")
    metrics.write_text(json.dumps(rows))
    assert night().exit_code == 0
    fleet.write_text("each: ['logs/*']\n")
    metrics.write_text(json.dumps(rows))
    assert night().exit_code == 0
