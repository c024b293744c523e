"""Two maps side by side: what is worse, by how much, and what is only different."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.schemas.metrics import METRICS
from scanloom.stages.evaluation.difference import mean_motion, path_difference
from scanloom.stages.geometry.se3 import F8, pose, se3_exp, so3_exp
from scanloom.workflows.cli import app
from scanloom.workflows.compare_maps import compare_maps, noise_of
from scanloom.workflows.comparison_text import text_of_comparison, text_of_noise
from scanloom.workflows.gate import as_it_was, worse_than
from scanloom.workflows.metric_changes import metric_changes
from scanloom.workflows.noise import measured, read_noise
from tests.delivered import cut, write_map
from tests.stages.mapping import circle, poses_of

RNG = np.random.default_rng(2)
LOG = "a" * 64


def street(points: int = 20_000) -> F8:
    rng = np.random.default_rng(1)
    ground = np.column_stack((rng.uniform(0, 100, (points, 2)), np.zeros(points)))
    wall = np.column_stack((rng.uniform(0, 100, points), np.full(points, 30.0), rng.uniform(0, 5, points)))
    return np.concatenate((ground, wall))


def rows(**values: float) -> list[dict[str, Any]]:
    """Metrics of the map by names with `__` for a dot."""
    return [
        {"name": name.replace("__", "."), "value": value, "unit": "", "scope": "map", "method": ""}
        for name, value in values.items()
    ]


def made(
    folder: Path, metrics: list[dict[str, Any]], points: F8 | None = None, T: F8 | None = None, log: str = LOG, name: str = "a",
) -> Path:  # fmt: skip
    """The folder of a map of one session."""
    tiles = cut(street() if points is None else points)
    session = {"name": name, "log": log}
    write_map(folder, tiles, sessions=[session], files={"map.ply": {"sha256": "", "bytes": 1234}})
    poses_of(circle(200) if T is None else T).write(folder / "trajectory.parquet")
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


# --- metrics ---


@pytest.mark.parametrize(
    ("name", "before", "after", "verdict"),
    [
        ("map.mme_r0.5_nat", -2.0, -1.97, "same"),  # 0.03 nat are allowed
        ("map.mme_r0.5_nat", -2.0, -1.96, "regression"),
        ("map.mme_r0.5_nat", -2.0, -2.04, "better"),
        ("loops.recall", 0.9, 0.85, "same"),
        ("loops.recall", 0.9, 0.84, "regression"),
        ("loops.recall", 0.84, 0.9, "better"),
        ("loops.precision", 1.0, 0.99, "regression"),  # nothing is allowed
        ("fusion.ate_rmse_m", 1.0, 1.15, "same"),  # 15 % are
        ("fusion.ate_rmse_m", 1.0, 1.16, "regression"),
        ("fusion.nees_translation", 2.0, 4.9, "same"),  # 3 is best, one off before, 1.9 after
        ("fusion.nees_translation", 2.0, 5.1, "regression"),
        ("map.points", 1e6, 2e6, "changed"),
        ("run.wall_s", 10.0, 100.0, "changed"),  # not judged without noise
        ("nobody.knows", 1.0, 2.0, "changed"),
        ("nobody.knows", 1.0, 1.0, "same"),
    ],
)
def test_a_change_is_worse_better_or_neither(name: str, before: float, after: float, verdict: str) -> None:
    a, b = ([{"name": name, "value": v, "scope": "map"}] for v in (before, after))
    (change,) = metric_changes(a, b, None)
    assert change.verdict == verdict


def test_metrics_of_one_map_only_are_shown_and_what_is_absent_may_have_a_meaning() -> None:
    a = rows(map__points=1.0)
    b = [*a, {"name": "odometry.segments", "value": 3.0}, {"name": "fusion.ate_rmse_m", "value": 1.0}]
    verdicts = {c.name: c.verdict for c in metric_changes(a, b, None)}
    assert verdicts == {
        "map.points": "same",
        "odometry.segments": "regression",
        "fusion.ate_rmse_m": "only in B",
    }
    assert {c.name: c.verdict for c in metric_changes(b, a, None)}["odometry.segments"] == "better"


def test_sessions_are_told_apart() -> None:
    a = [{"name": "fusion.ate_rmse_m", "value": v, "session": s} for s, v in (("x", 1.0), ("y", 2.0))]
    b = [{**row, "value": row["value"] + 1} for row in reversed(a)]
    changes = metric_changes(a, b, None)
    assert [(c.session, c.before, c.after, c.verdict) for c in changes] == [
        ("x", 1.0, 2.0, "regression"), ("y", 2.0, 3.0, "regression")]  # fmt: skip
    judged = {c.session: c.verdict for c in metric_changes(a, b, None, frozenset({"y"}))}
    assert judged == {"x": "changed", "y": "regression"}


@pytest.mark.parametrize("kind", METRICS, ids=lambda kind: kind.name)
def test_the_same_value_is_never_a_regression_and_much_worse_always_is(kind: Any) -> None:
    name = kind.name.replace("*", "x")
    for value in (0.0, 0.7, 30.0):
        same = metric_changes(*[[{"name": name, "value": value}]] * 2, None)
        assert same[0].verdict == "same"
        if kind.better and not kind.varies:
            worse = value + {"lower": 1e4, "higher": -1e4, "target": 1e4}[kind.better]
            (change,) = metric_changes(
                [{"name": name, "value": value}], [{"name": name, "value": worse}], None
            )
            assert change.verdict == "regression"


# --- noise ---


@pytest.mark.parametrize("repeats", [3, 5, 10])
def test_two_runs_of_the_same_log_are_hardly_ever_a_regression_and_a_large_change_is(repeats: int) -> None:
    alarms = found = 0
    for _ in range(2000):
        values = RNG.normal(5.0, 0.1, repeats + 2)
        noise = measured(
            [(str(i), rows(map__mme_x_nat=0, fusion__ate_rmse_m=v)) for i, v in enumerate(values[2:])]
        )
        for shift in (0.0, 0.1 * {3: 120, 5: 25, 10: 10}[repeats]):
            a, b = rows(fusion__ate_rmse_m=values[0]), rows(fusion__ate_rmse_m=values[1] + shift)
            (change,) = metric_changes(a, b, noise)
            assert change.source == "noise"
            if shift:
                found += change.verdict == "regression"
            else:
                alarms += change.verdict == "regression"
    assert alarms <= 9  # 2 are expected, 9 come once in 5000 times
    assert found > 1900


def test_noise_makes_run_times_judged_and_too_few_repeats_do_not() -> None:
    slow = metric_changes(
        rows(run__wall_s=10),
        rows(run__wall_s=100),
        measured([("", rows(run__wall_s=w)) for w in (9, 10, 11)]),
    )
    assert slow[0].verdict == "regression" and slow[0].allowed == pytest.approx(22.33 * 2**0.5, rel=0.01)
    with pytest.raises(UsageError, match="2 runs"):
        measured([("", rows(map__points=1))] * 2)
    partly = measured(
        [("", rows(map__points=1)), ("", rows(loops__recall=0.1)), ("", rows(loops__recall=0.2))]
    )
    assert partly.tolerance(("loops.recall", "")) is None


@pytest.mark.parametrize(("lost", "verdict"), [(5.0, "same"), (6.0, "regression")])
def test_what_did_not_vary_in_the_repeats_has_the_default(lost: float, verdict: str) -> None:
    noise = measured([("", rows(odometry__unreliable_scans=0.0))] * 3)
    (change,) = metric_changes(
        rows(odometry__unreliable_scans=0.0), rows(odometry__unreliable_scans=lost), noise
    )
    assert (change.verdict, change.source, change.allowed) == (verdict, "default", 5.0)


def test_noise_is_written_and_read(tmp_path: Path) -> None:
    noise = measured(
        [(f"m{i}", rows(map__mme_r1_nat=v, map__tiles=4)) for i, v in enumerate((1.0, 1.2, 1.4))]
    )
    noise.write(tmp_path / "noise.json")
    assert read_noise(tmp_path / "noise.json") == noise
    assert noise.spreads["map.mme_r1_nat", ""].deviation == pytest.approx(0.2)
    assert "map.mme_r1_nat" in text_of_noise(noise) and "1 metrics were the same in all 3" in text_of_noise(
        noise
    )
    for text in ("{}", "[]", "no json", '{"format": "scanloom noise 1", "maps": [], "metrics": [{}]}'):
        (tmp_path / "other.json").write_text(text)
        with pytest.raises(InvalidInput, match="no file of noise"):
            read_noise(tmp_path / "other.json")


# --- trajectories and points ---


def test_a_moved_map_is_shifted_and_not_bent() -> None:
    T = circle(300)
    moved = pose(so3_exp([0, 0, 0.02]), [3.0, 4.0, 0.5]) @ T
    found = path_difference(T, moved, np.eye(4))
    assert found.aligned_rms_m < 1e-9 and found.aligned_rms_deg < 1e-6
    assert found.shift_deg == pytest.approx(np.degrees(0.02), abs=1e-9)
    assert found.as_they_stand_rms_m == pytest.approx(5.4, abs=0.6)
    assert path_difference(T, moved, None).shift_m is None


def test_a_straight_drive_is_not_turned_about_itself() -> None:
    T = pose(
        np.tile(np.eye(3), (100, 1, 1)), np.column_stack((np.arange(100.0), np.zeros(100), np.zeros(100)))
    )
    noisy = T @ se3_exp(RNG.normal(0, [1e-4] * 3 + [1e-3] * 3, (100, 6)))
    motion = mean_motion(T, noisy)
    assert np.abs(motion - np.eye(4)).max() < 1e-3
    assert 0.001 < path_difference(T, noisy, np.eye(4)).aligned_rms_m < 0.0025


def test_points_that_are_only_in_one_map_are_found(tmp_path: Path) -> None:
    box = np.random.default_rng(4).uniform([10, 10, 1], [14, 14, 3], (8000, 3))
    a = made(tmp_path / "a", rows(map__points=1))
    b = made(tmp_path / "b", rows(map__points=1), np.concatenate((street(), box)))
    found = compare_maps(a, b)
    assert found.a_to_b is not None and found.b_to_a is not None
    assert found.a_to_b.only_share == 0.0 and found.a_to_b.p95_m == 0.0
    high = (box[:, 2] > 1.0).sum() * 0.75  # of the box, what lies above half a metre from the rest
    assert 0.5 * high / 48_000 < found.b_to_a.only_share < 1.4 * 8000 / 44_000


def test_maps_of_moved_frames_have_the_same_points(tmp_path: Path) -> None:
    """The second map starts at another place: its tiles are cut elsewhere."""
    motion = pose(so3_exp([0, 0, 0.3]), [7.0, -12.0, 1.0])
    a = made(tmp_path / "a", rows())
    b = made(tmp_path / "b", rows(), street() @ motion[:3, :3].T + motion[:3, 3], motion @ circle(200))
    found = compare_maps(a, b)
    assert found.paths["a"].aligned_rms_m < 1e-6
    assert found.paths["a"].shift_m is not None and found.paths["a"].shift_m > 5
    for way in (found.a_to_b, found.b_to_a):
        assert way is not None and way.p95_m < 1e-4 and way.only_share == 0.0 and way.samples > 10_000


@pytest.mark.parametrize("offset_m", [0.02, 0.3])
def test_a_part_of_the_map_that_moved_shows_in_the_distances(tmp_path: Path, offset_m: float) -> None:
    points = street()
    sunk = points - np.array([0, 0, offset_m]) * (points[:, 1] < 29)[:, None]
    found = compare_maps(made(tmp_path / "a", rows()), made(tmp_path / "b", rows(), sunk))
    assert found.a_to_b is not None
    assert found.a_to_b.p95_m >= 0.9 * offset_m
    assert found.a_to_b.only_share < 0.05


# --- the command ---


def test_a_regression_ends_with_five_and_says_which(tmp_path: Path) -> None:
    a = made(tmp_path / "a", rows(map__mme_r0__5_nat=-2.0, loops__recall=0.9))
    b = made(tmp_path / "b", rows(map__mme_r0__5_nat=-1.5, loops__recall=0.9))
    for names, code in (([a, b], 5), ([b, a], 0), ([a, a], 0)):
        done = CliRunner().invoke(app, ["compare", *map(str, names)])
        assert done.exit_code == code, done.output
    worse = CliRunner().invoke(app, ["compare", str(a), str(b), "--json"])
    body = json.loads(worse.stdout)
    assert body["exit_code"] == worse.exit_code == 5
    assert body["regressions"] == ["map.mme_r0.5_nat"]
    assert {row["name"] for row in body["metrics"]} == {"map.mme_r0.5_nat", "loops.recall"}
    text = text_of_comparison(compare_maps(a, b))
    assert "WORSE" in text and "1 of 2 judged" in text and "default" in text


def test_noise_from_maps_or_a_file_decides(tmp_path: Path) -> None:
    folders = [
        made(tmp_path / f"m{i}", rows(map__mme_r0__5_nat=v))
        for i, v in enumerate((-2.0, -1.98, -2.02, -1.95, -2.2))
    ]
    runs = [w for folder in folders[:3] for w in ("--noise", str(folder))]
    compare = ["compare", str(folders[0]), str(folders[3])]
    assert CliRunner().invoke(app, compare).exit_code == 5
    assert CliRunner().invoke(app, [*compare, *runs]).exit_code == 0
    file = str(tmp_path / "noise.json")
    told = CliRunner().invoke(app, ["compare", *map(str, folders[:3]), "--measure-noise", file])
    assert told.exit_code == 0 and "map.mme_r0.5_nat" in told.stdout
    assert CliRunner().invoke(app, [*compare, "--noise", file]).exit_code == 0
    assert noise_of([Path(file)]) == noise_of(folders[:3])


def test_maps_of_different_logs_are_shown_and_not_judged(tmp_path: Path) -> None:
    a = made(tmp_path / "a", rows(map__mme_r0__5_nat=-2.0))
    b = made(tmp_path / "b", rows(map__mme_r0__5_nat=0.0), log="b" * 64)
    found = compare_maps(a, b)
    assert found.exit_code == 0 and "different logs" in found.notes[0]
    assert found.metrics[0].verdict == "changed"
    renamed = made(tmp_path / "c", rows(map__mme_r0__5_nat=0.0), name="otherwise")
    assert compare_maps(a, renamed).exit_code == 5  # the same log under another name
    assert set(compare_maps(a, renamed).paths) == {"a"}


def test_what_is_no_map_is_refused_in_words(tmp_path: Path) -> None:
    a = made(tmp_path / "a", rows(map__points=1))
    (tmp_path / "empty").mkdir()
    old, bare = tmp_path / "old", tmp_path / "bare"
    shutil.copytree(a, old)
    (old / "map.json").write_text((old / "map.json").read_text().replace("scanloom map 1", "scanloom map 0"))
    shutil.copytree(a, bare)
    (bare / "metrics.json").unlink()
    for folder, words in (
        (tmp_path / "empty", "holds no map"), (tmp_path / "nowhere", "holds no map"), (old, "scanloom map 0"), (bare, "metrics.json"),
    ):  # fmt: skip
        with pytest.raises(InvalidInput) as caught:
            compare_maps(a, folder)
        assert words in str(caught.value)
    done = CliRunner().invoke(app, ["compare", str(a)])
    assert isinstance(done.exception, UsageError)


def test_damaged_tiles_leave_the_metrics_to_be_compared(tmp_path: Path) -> None:
    a, b = (made(tmp_path / n, rows(map__mme_r0__5_nat=-2.0)) for n in "ab")
    (b / "tiles" / "0_0.parquet").write_bytes(b"nothing")
    found = compare_maps(a, b)
    assert found.a_to_b is None and found.paths and found.metrics
    assert any("Points are not compared" in note for note in found.notes)
    (b / "tiles" / "index.parquet").write_bytes(b"nothing")
    assert any("Trajectories and points are not compared" in note for note in compare_maps(a, b).notes)


def test_settings_and_sizes_that_differ_are_named(tmp_path: Path) -> None:
    a, b = (made(tmp_path / n, rows()) for n in "ab")
    for folder, value in ((a, 0.5), (b, 0.4)):
        sources = {
            "format": "scanloom sources 1",
            "sessions": [],
            "settings": {"odometry": {"voxel_size_m": value}},
            "store": "",
        }
        (folder / "sources.json").write_text(json.dumps(sources))
    found = compare_maps(a, b)
    assert [vars(row) for row in found.settings] == [
        {"name": "odometry.voxel_size_m", "a": "0.5", "b": "0.4"}
    ]
    assert {row.name: row.a for row in found.sizes}["bytes of all files"] == "1 234"
    assert "odometry.voxel_size_m" in text_of_comparison(found)
    assert replace(found, metrics=[]).exit_code == 0


def test_the_gate_holds_a_map_against_what_its_folder_held_before(tmp_path: Path) -> None:
    folder = made(tmp_path / "a", rows(map__mme_r0__5_nat=-2.0, loops__recall=0.9))
    before = as_it_was(folder)
    assert worse_than(before, folder, None) == []
    (folder / "metrics.json").write_text(json.dumps(rows(map__mme_r0__5_nat=-1.9, loops__recall=0.9)))
    (text,) = worse_than(before, folder, None)
    assert text == "regression: map.mme_r0.5_nat went from -2 to -1.9; 0.03 are allowed (default)"
    noise = measured([("", rows(map__mme_r0__5_nat=v)) for v in (-2.0, -1.98, -2.02)])
    assert worse_than(before, folder, noise) == []
    other = made(tmp_path / "b", rows(map__mme_r0__5_nat=5.0), log="b" * 64)
    assert worse_than(before, other, None) == []  # other logs say nothing
    assert as_it_was(tmp_path / "nowhere") is None
    assert worse_than(None, folder, None) == worse_than(before, tmp_path / "nowhere", None) == []


@pytest.mark.parametrize(("changed", "code"), [({"seed": 7}, 5), ({"duration_s": 20.0}, 0)])
def test_simulated_logs_that_differ_in_noise_alone_are_the_same_log(
    tmp_path: Path, changed: dict[str, Any], code: int
) -> None:
    told = {"seed": 0, "duration_s": 10.0}
    a = made(tmp_path / "a", rows(map__mme_r0__5_nat=-2.0), log="1" * 64)
    b = made(tmp_path / "b", rows(map__mme_r0__5_nat=-1.0), log="2" * 64)
    for folder, settings in ((a, told), (b, told | changed)):
        session = {"name": "a", "word": "sample", "settings": {"simulate": settings}}
        sources = {"format": "scanloom sources 1", "sessions": [session], "settings": {}, "store": ""}
        (folder / "sources.json").write_text(json.dumps(sources))
    assert compare_maps(a, b).exit_code == code


def test_the_page_holds_everything_and_escapes_what_logs_say(tmp_path: Path) -> None:
    a = made(tmp_path / "a", rows(map__mme_r0__5_nat=-2.0, map__points=5), name="<b>drive</b>")
    b = made(tmp_path / "b", rows(map__mme_r0__5_nat=-1.0, map__points=5), name="<b>drive</b>")
    target = tmp_path / "out" / "page.html"
    done = CliRunner().invoke(app, ["compare", str(a), str(b), "--report", str(target)])
    assert done.exit_code == 5
    page = target.read_text()
    assert "<b>drive</b>" not in page and "&lt;b&gt;drive" in page
    assert "map.mme_r0.5_nat is worse than allowed" in page and "A to B" in page
    assert "src=" not in page and "http" not in page
