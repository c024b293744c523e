"""Real false loops, and graphs with a proved optimum: the very solver of the product on published graphs.

Bicocca 2009-02-25b has 446 loops by appearance, about half of them wrong: all of them in a plain least-squares solver give
42 m, odometry alone 4.3 m, the loops thresholded by their authors 1.0 m.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import bicocca, costs, pose_graphs

pytestmark = [pytest.mark.real, pytest.mark.slow]


def test_false_loops_do_not_bend_the_map(shared_data: Path) -> None:
    path = shared_data / "pose_graphs" / bicocca.FILE
    truth = bicocca.truth(path.parent)
    assert 4.0 < truth.ate_m(pose_graphs.read(path).from_odometry()) < 4.7
    T, factors = bicocca.ours(path)
    verdicts = [f.verdict for f in factors if f.kind == "loop"]
    assert len(verdicts) == 446
    assert 0.5 < truth.ate_m(T) <= 1.0
    assert 150 < sum(not v for v in verdicts) < 240
    np.testing.assert_allclose(T[:, 2, 3], 0.0, atol=1e-6)


@pytest.mark.parametrize("name", costs.OPTIMA)
def test_graphs_without_false_loops_reach_the_proved_optimum(name: str, shared_data: Path) -> None:
    figures = {f.name: f.value for f in costs.figures(shared_data / "pose_graphs" / f"{name}.g2o")}
    name = name.replace("-", "_")
    assert 0.999 < figures[f"{name}.cost_over_optimum"] < 1.001
    assert figures[f"{name}.loops_refused"] == 0
