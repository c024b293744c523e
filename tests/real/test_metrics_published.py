"""Our metrics against figures others published for the same trajectories (KISS-ICP on KITTI odometry)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.stages.geometry.alignment import absolute_errors, kitti_errors, rms, travelled
from scanloom.stages.geometry.se3 import F8, matrix_from_quaternion, pose

pytestmark = pytest.mark.real


def read_tum(path: Path) -> F8:
    """Poses (n, 4, 4) of a TUM file: stamp, tx ty tz, qx qy qz qw."""
    rows = np.loadtxt(path)
    return pose(matrix_from_quaternion(rows[:, [7, 4, 5, 6]]), rows[:, 1:4])


@pytest.mark.parametrize(
    ("sequence", "t_rel_percent", "ate_m", "length_m"),
    [("00", 0.527, 3.515, 3724.0), ("01", 0.786, 3.150, 2453.0)],
)
def test_drift_and_ate_are_as_published(
    shared_data: Path, sequence: str, t_rel_percent: float, ate_m: float, length_m: float
) -> None:
    folder = shared_data / f"kitti_{sequence}_trajectory"
    truth, estimate = read_tum(folder / "truth_tum.txt"), read_tum(folder / "kiss_icp_tum.txt")
    drift = kitti_errors(truth, estimate)
    assert drift is not None
    assert drift.t_rel_percent == pytest.approx(t_rel_percent, abs=0.0006)
    assert rms(absolute_errors(truth, estimate)) == pytest.approx(ate_m, abs=0.003)
    assert travelled(truth)[-1] == pytest.approx(length_m, abs=1.0)
    assert 0.05 < drift.r_rel_deg_per_100m < 0.3
