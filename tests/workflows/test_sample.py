"""The sample drive with a coarser LiDAR, end to end: drift, error and loops against truth, within two-sided bounds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.workflows.test_map import scanloom

COARSE = ("--set", "simulate.beams=16", "--set", "simulate.columns=512")


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    folder: Path = tmp_path_factory.mktemp("sample")
    done = scanloom("map", "sample", "--out", "out", *COARSE, "--json", cwd=folder, timeout_s=900)
    assert done.returncode == 0, done.stderr
    return {row["name"]: row["value"] for row in json.loads(done.stdout)["metrics"]}


def test_odometry_drifts_as_noise_demands(figures: dict[str, float]) -> None:
    assert figures["odometry.scans"] == 1800
    assert 0.02 < figures["odometry.kitti_t_rel_percent"] <= 1.5


def test_poses_are_near_truth(figures: dict[str, float]) -> None:
    assert 0.005 < figures["fusion.ate_rmse_m"] <= 0.5
    assert figures["fusion.georeferenced"] == 1


def test_loops_are_found_and_true(figures: dict[str, float]) -> None:
    assert figures["loops.accepted"] >= 1
    assert figures["loops.precision"] == 1.0
