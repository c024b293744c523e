"""The better variant, ratios, names of sequences, the clock of frames, the reference's graph."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import reference
from benchmarks.comparison import Result, best, ratios
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
    said = {score.name: score.value for score in ratios(chosen, {})}
    assert said["ratio.kiss_icp"] == pytest.approx((0.5 + 0.75) / 2)
    assert said["ratio.kiss_icp.worst"] == pytest.approx(0.75)
    assert said["ratio.kiss_icp.simulated"] == pytest.approx(0.5)
    assert said["time_ratio.odometry"] == pytest.approx((0.5 + 0.25) / 2)
    assert said["time_ratio.with_deskew.worst"] == pytest.approx(0.6)
    assert not [name for name in said if "small_gicp" in name]


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
