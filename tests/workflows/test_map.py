"""`map` from the outside: what is delivered, run again, changed settings, bad input."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanloom.stages.report.templates import asset
from tests.logs import scan_folder


def scanloom(*words: object, cwd: Path, timeout_s: float = 300) -> subprocess.CompletedProcess[str]:
    """Run the command line as a user would."""
    return subprocess.run(
        [sys.executable, "-m", "scanloom.workflows.cli", *map(str, words)],
        cwd=cwd, capture_output=True, text=True, timeout=timeout_s,
    )  # fmt: skip


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> Path:
    """A folder with a log of 14 scans, mapped once."""
    folder = tmp_path_factory.mktemp("mapped")
    scan_folder(folder / "log")
    done = scanloom("map", "log", "--out", "out", "--cluster", "none", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "said.json").write_text(done.stdout)
    return folder


def test_everything_is_delivered(mapped: Path) -> None:
    out = mapped / "out"
    for name in (
        "map.ply",
        "removed.ply",
        "objects.parquet",
        "loops.parquet",
        "trajectory.parquet",
        "trajectory.tum",
        "metrics.json",
        "report.html",
        "preview.png",
        "map.json",
    ):
        assert (out / name).stat().st_size > 0, name
    tum = np.loadtxt(out / "trajectory.tum")
    assert tum.shape == (14, 8)
    assert np.allclose(np.linalg.norm(tum[:, 4:], axis=1), 1, atol=1e-6)
    assert 0.05 < np.abs(np.diff(tum[:, 0])).max() < 0.15
    described = json.loads((out / "map.json").read_text())
    on_disk = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert set(described["files"]) == on_disk - {
        ".scanloom", "map.json", "sources.json", "metrics.json", "report.html",
    }  # fmt: skip
    assert described["points"] == pq.read_table(out / "tiles/index.parquet")["points"].to_numpy().sum()


def test_metrics_have_name_value_unit_scope_method(mapped: Path) -> None:
    rows = json.loads((mapped / "out/metrics.json").read_text())
    assert all({"name", "value", "unit", "scope", "method"} <= set(row) for row in rows)
    values = {row["name"]: row["value"] for row in rows}
    assert values["run.peak_rss_mb"] > 50
    assert values["run.realtime_factor"] == pytest.approx(
        values["run.log_s"] / values["run.wall_s"], rel=0.02
    )
    assert values["odometry.path_length_m"] == pytest.approx(13 * 0.8, rel=0.03)
    assert rows == json.loads((mapped / "said.json").read_text())["metrics"]


def test_report_is_one_self_contained_file(mapped: Path) -> None:
    page = (mapped / "out/report.html").read_text()
    library = asset("vendor/plotly-basic.min.js")
    assert page.count(library) == 1
    own = page.replace(library, "").replace("http://www.w3.org", "")
    assert "http://" not in own and "https://" not in own
    assert "default-src &#39;none&#39;; img-src data: blob:" in own
    assert own.count('src="data:image/webp;base64,') == 3
    assert own.count('<script type="application/json">') >= 5


def test_report_tells_what_was_changed_and_what_the_map_was_made_of(mapped: Path) -> None:
    page = (mapped / "out/report.html").read_text()
    described = json.loads((mapped / "out/map.json").read_text())
    assert described["files"]["map.ply"]["sha256"] in page
    assert described["sessions"][0]["log"] in page
    assert hashlib.sha256((mapped / "out/map.json").read_bytes()).hexdigest() in page


def test_again_runs_no_stage_and_changes_no_byte(mapped: Path) -> None:
    before = {p: p.read_bytes() for p in (mapped / "out").rglob("*") if p.is_file()}
    done = scanloom("map", "log", "--out", "out", "--json", cwd=mapped)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["executed"] == 0
    assert {p: p.read_bytes() for p in (mapped / "out").rglob("*") if p.is_file()} == before


def test_tile_size_reruns_tiling_and_what_follows(mapped: Path) -> None:
    words = ("map", "log", "--out", "out", "--set", "tiling.tile_size_m=20", "--dry-run", "--json")
    plan = json.loads(scanloom(*words, cwd=mapped).stdout)["tasks"]
    verdicts = {task["node"]: task["verdict"] for task in plan}
    assert verdicts.pop("tiling") == "RUN"
    assert "tile_size_m" in next(task["reason"] for task in plan if task["node"] == "tiling")
    after = {"changes", "tiles", "overview", "picture", "evaluation", "report"}
    assert {node for node, verdict in verdicts.items() if verdict != "HIT"} == after


def test_a_dry_run_shows_keys_that_explain_knows(mapped: Path) -> None:
    said = scanloom("map", "log", "--out", "out", "--dry-run", cwd=mapped)
    (line,) = (line for line in said.stdout.splitlines() if line.split()[1] == "fusion")
    verdict, _, key, *reason = line.split()
    assert (verdict, reason) == ("HIT", ["already", "computed"])
    done = scanloom("explain", key, cwd=mapped)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("fusion ") and key in done.stdout.splitlines()[0]
    unknown = scanloom("explain", "zzz", cwd=mapped)
    assert unknown.returncode == 2 and "--dry-run` shows the keys" in unknown.stderr


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p: None, "no such file"),
        (lambda p: p.write_bytes(b""), "empty"),
        (lambda p: p.write_text("this is a shopping list, not a log\n" * 50), "plain text"),
    ],
    ids=["missing", "empty", "text"],
)
def test_no_log_at_all_is_exit_code_4(tmp_path: Path, make, said: str) -> None:
    make(tmp_path / "drive.bag")
    for verb in (("map",), ("inspect",)):
        done = scanloom(*verb, "drive.bag", cwd=tmp_path)
        assert done.returncode == 4, done.stderr
        assert "Traceback" not in done.stderr and "drive.bag" in done.stderr and "Next:" in done.stderr
        assert said in done.stderr
    assert not (tmp_path / "maps").exists()


def test_unknown_setting_names_the_nearest(mapped: Path) -> None:
    done = scanloom("map", "log", "--set", "tiling.tile_sise_m=20", cwd=mapped)
    assert done.returncode == 2
    assert "tile_size_m" in done.stderr and "Traceback" not in done.stderr


def test_foreign_folder_is_not_touched(mapped: Path) -> None:
    foreign = mapped / "holiday"
    foreign.mkdir()
    (foreign / "beach.jpg").write_bytes(b"sand")
    done = scanloom("map", "log", "--out", "holiday", cwd=mapped)
    assert done.returncode == 2 and "nothing there was touched" in done.stderr
    assert [p.name for p in foreign.iterdir()] == ["beach.jpg"]


def test_bad_session_beside_a_good_one(mapped: Path) -> None:
    (mapped / "bad.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    done = scanloom("map", "log", "bad.bag", "--out", "both", "--cluster", "none", cwd=mapped)
    assert done.returncode == 3, done.stderr
    assert "bad.bag" in done.stderr and (mapped / "both/map.ply").exists()
