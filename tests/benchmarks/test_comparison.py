"""The better variant, ratios, names of sequences, the clock of frames, the reference's graph."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import reference, scores, systems
from benchmarks.comparison import VARIANTS, Result, Runner, best, ratios
from benchmarks.scores import Score
from benchmarks.sequences import drives
from benchmarks.systems import Clock, Outcome, _orthonormal
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, se3_log


def result(sequence: str, system: str, variant: str = "", **values: float) -> Result:
    recording = SimpleNamespace(name=sequence, simulated=sequence != "real")
    outcome = Outcome(np.zeros(1, np.int64), np.eye(4)[None], np.ones(1), 1.0, 1)
    return Result(recording, system, variant, outcome, [Score(k, v, "", "") for k, v in values.items()])


def test_the_better_variant_stands_for_a_system_and_a_lost_one_never_does() -> None:
    tried = [
        result("a", "small_gicp", "lost", lost_scans=50),
        result("a", "small_gicp", "good", rpe10_m=0.1),
        result("a", "small_gicp", "poor", rpe10_m=0.3),
    ]
    assert best(tried).variant == "good"


def test_ratios_are_means_of_ratios() -> None:
    times = {"ms_per_frame_mean": 10.0, "deskew_ms_per_frame_mean": 2.0}
    chosen = {
        ("a", "scanloom"): result("a", "scanloom", rpe10_m=0.1, **times),
        ("a", "kiss_icp"): result("a", "kiss_icp", rpe10_m=0.2, ms_per_frame_mean=20.0),
        ("real", "scanloom"): result("real", "scanloom", rpe10_m=0.3, **times),
        ("real", "kiss_icp"): result("real", "kiss_icp", rpe10_m=0.4, ms_per_frame_mean=40.0),
    }
    said = {score.name: score.value for score in ratios(chosen)}
    assert said["ratio.kiss_icp"] == pytest.approx((0.5 + 0.75) / 2)
    assert said["ratio.kiss_icp.worst"] == pytest.approx(0.75)
    assert said["ratio.kiss_icp.simulated"] == pytest.approx(0.5)
    assert said["time_ratio.odometry"] == pytest.approx((0.5 + 0.25) / 2)
    assert said["time_ratio.with_deskew.worst"] == pytest.approx(0.6)
    assert not [name for name in said if "gicp" in name]


def test_the_system_small_gicp_and_its_registration_alone_are_compared_apart() -> None:
    chosen = {
        ("a", "scanloom"): result("a", "scanloom", rpe10_m=0.3),
        ("a", "small_gicp"): result("a", "small_gicp", rpe10_m=0.6),
        ("a", "vgicp_on_our_scans"): result("a", "vgicp_on_our_scans", rpe10_m=0.2),
    }
    said = {score.name: score.value for score in ratios(chosen)}
    assert said["ratio.small_gicp.a"] == said["ratio.small_gicp.worst"] == pytest.approx(0.5)
    assert said["ratio.vgicp_on_our_scans.a"] == said["ratio.vgicp_on_our_scans"] == pytest.approx(1.5)
    scans = {s: {o["scans"] for o in VARIANTS[s].values()} for s in ("small_gicp", "vgicp_on_our_scans")}
    assert scans == {"small_gicp": {"own"}, "vgicp_on_our_scans": {"ours"}}


def test_what_vgicp_said_of_our_scans_is_kept_under_the_program_and_those_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(systems, "version", lambda system: "1.0")
    recording = SimpleNamespace(name="a", digest="raw", deskewed_digest="flat")
    kept = result("a", "small_gicp").outcome
    kept.write(tmp_path / "a_small_gicp_1.0_scans=ours-voxel_m=0.5_flat.npz")
    kept.write(tmp_path / "a_small_gicp_1.0_scans=own-voxel_m=0.5_raw.npz")
    runner = Runner(tmp_path)
    for system in ("small_gicp", "vgicp_on_our_scans"):
        found = runner.outcome(system, recording, VARIANTS[system]["0.5m"])
        assert np.array_equal(found.T, kept.T)


def test_time_of_the_sensor_check_is_told_once_it_was_taken() -> None:
    without = Outcome(np.zeros(4, np.int64), np.tile(np.eye(4), (4, 1, 1)), np.ones(4), 1.0, 1)
    assert not [*scores.sensors(without)]
    without.extra["sensors_ms"] = np.array(100.0)
    said = {score.name: score.value for score in scores.sensors(without)}
    assert said == {"sensors_ms_per_session": 100.0, "sensors_ms_per_scan": 25.0}


def test_sequences_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "my drive-2"
    folder.mkdir()
    assert [d.name for d in drives([folder], ["my_drive_2", "field"])] == ["field", "my_drive_2"]
    with pytest.raises(SystemExit, match="no sequence nowhere; there are town_32"):
        drives([], ["nowhere"])


def test_time_between_frames_sums_up_to_the_whole() -> None:
    clock = Clock()
    clock.ticks = [clock.started, clock.started + 0.001, clock.started + 0.004]
    ms = clock.per_frame(3)
    assert ms[1] / ms[0] == pytest.approx(3.0, rel=1e-6)
    assert len(ms) == 3


def test_rounding_does_not_grow() -> None:
    T = se3_exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    off = T.copy()
    off[:3, :3] *= 1.0 + 1e-6
    again = _orthonormal(off)
    assert np.abs(again - T).max() < 1e-9
    assert np.abs(again[:3, :3] @ again[:3, :3].T - np.eye(3)).max() < 1e-14


def test_reference_averages_its_pairs_and_bears_a_wrong_one() -> None:
    rng = np.random.default_rng(2)
    true = np.array([se3_exp(k * np.array([0, 0, 0.05, 0.5, 0, 0])) for k in range(12)])
    edges = []
    for apart in (1, 2, 4):
        for i in range(len(true) - apart):
            noise = se3_exp(np.array([1e-3] * 3 + [0.01] * 3) * rng.standard_normal(6))
            edges.append(reference._Edge(i, i + apart, inverse(true[i]) @ true[i + apart] @ noise))
    edges[5] = reference._Edge(edges[5].i, edges[5].j, pose(np.eye(3), [0.0, 3.0, 0.0]))
    start = true @ se3_exp(np.array([0.02] * 3 + [0.1] * 3) * rng.standard_normal((12, 6)))
    start[0] = true[0]
    found = reference._joined(start, edges)
    off = se3_log(inverse(true) @ found)
    assert 1e-4 < np.abs(off[:, 3:]).max() < 0.05


def test_twists_are_of_the_neighbours() -> None:
    twist = np.array([0, 0, 0.3, 5.0, 0, 0])
    T = np.array([se3_exp(0.1 * k * twist) for k in range(5)])
    found = reference.twists(10**18 + 10**8 * np.arange(5), T)
    assert np.abs(found - twist).max() < 1e-9
