"""Real false loops: Bicocca 2009-02-25b with 446 loops by appearance, many of them wrong.

All 446 in a plain least-squares solver give 42 m, odometry alone 4.35 m (see the data's description).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.solving import solve
from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from tests.stages.fusion.drives import ate

pytestmark = [pytest.mark.real, pytest.mark.slow]

PLANE_SIGMA = np.array([1e-3, 1e-3, 1.0, 1.0, 1.0, 1e-3])
"""Tight where a plane graph says nothing (roll, pitch, height); heading and x, y come from the file."""


def planar(x: float, y: float, yaw: float) -> F8:
    return pose(so3_exp([0.0, 0.0, yaw]), [x, y, 0.0])


def read(path: Path) -> list[Factor]:
    factors = []
    for line in path.read_text().splitlines():
        if line.startswith("EDGE_SE2"):
            i, j, x, y, yaw, *info = (float(v) for v in line.split()[1:12])
            sigma = PLANE_SIGMA.copy()
            sigma[[3, 4, 2]] = 1.0 / np.sqrt([info[0], info[3], info[5]])
            kind = "odometry" if j == i + 1 else "loop"
            factors.append(Factor(kind, int(i), int(j), planar(x, y, yaw), np.diag(sigma**2)))
    return factors


def test_false_loops_do_not_bend_the_map(shared_data: Path) -> None:
    folder = shared_data / "pose_graphs"
    factors = read(folder / "B25b_0.000.g2o")
    nodes = [np.eye(4)]
    for factor in factors:
        if factor.kind == "odometry":
            nodes.append(nodes[-1] @ factor.measurement)
    factors.append(Factor("prior", 0, -1, np.eye(4), np.eye(6) * 1e-6))
    start = np.array(nodes)
    solution = solve(start, factors, 0.999)
    truth = np.loadtxt(folder / "Bicocca_2009-02-25b-GT-extended.csv", delimiter=",")
    stamps = np.loadtxt(folder / "B25b_timestamps.txt", ndmin=1)
    known = (stamps > truth[0, 0]) & (stamps < truth[-1, 0])
    true = np.zeros((known.sum(), 4, 4))
    for axis in (0, 1):
        true[:, axis, 3] = np.interp(stamps[known], truth[:, 0], truth[:, 1 + axis])
    alone, fused = ate(start[known], true), ate(solution.T[known], true)
    verdicts = [f.verdict for f in factors if f.kind == "loop"]
    assert len(verdicts) == 446
    assert 4.0 < alone < 4.7
    assert 0.5 < fused < 1.5
    assert 100 < sum(not v for v in verdicts) < 350
