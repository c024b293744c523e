"""Reading g2o: the order of quaternion and information is converted at the boundary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import pose_graphs


def test_space_graph(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = np.arange(1, 22) * 0.01
    upper += np.diag([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    numbers = " ".join(str(v) for v in upper[np.triu_indices(6)])
    path = tmp_path / "a.g2o"
    path.write_text(
        f"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 2 3 0 0 {half} {half}\n"
        f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 {half} {half} {numbers}\nEDGE_SE3:QUAT 0 7 0 0 0 0 0 0 1 {numbers}\n"
    )
    graph = pose_graphs.read(path)
    edge = graph.factors[0]
    np.testing.assert_allclose(edge.measurement, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)  # fmt: skip
    information = np.linalg.inv(edge.covariance)
    whole = np.triu(upper) + np.triu(upper, 1).T
    np.testing.assert_allclose(information[3:, 3:], whole[:3, :3])
    np.testing.assert_allclose(information[:3, :3], whole[3:, 3:])
    np.testing.assert_allclose(information[:3, 3:], whole[3:, :3])
    assert [f.kind for f in graph.factors] == ["odometry", "loop"]
    assert not graph.flat


def test_plane_graph(tmp_path: Path) -> None:
    path = tmp_path / "b.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\nVERTEX_SE2 2 0 0 0\n"
                    "EDGE_SE2 0 1 1 2 0.5 4 1 0.5 9 0.25 16\nEDGE_SE2 1 2 1 0 0 4 0 0 9 0 16\nEDGE_SE2 0 2 3 1 0 4 0 0 9 0 16\n")  # fmt: skip
    graph = pose_graphs.read(path)
    assert graph.flat
    block = np.linalg.inv(graph.factors[0].covariance[np.ix_([3, 4, 2], [3, 4, 2])])
    np.testing.assert_allclose(block, [[4, 1, 0.5], [1, 9, 0.25], [0.5, 0.25, 16]])
    loop = np.diag(graph.factors[2].covariance)
    np.testing.assert_array_equal(np.isinf(loop), [True, True, False, False, False, True])
    np.testing.assert_allclose(graph.from_odometry()[2, :2, 3], [1 + np.cos(0.5), 2 + np.sin(0.5)])


def test_other_lines_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.g2o"
    path.write_text("VERTEX_XY 0 0 0\n")
    with pytest.raises(ValueError, match="VERTEX_XY"):
        pose_graphs.read(path)
