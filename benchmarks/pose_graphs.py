"""Pose graphs as g2o files hold them, as factors of the fusion.

g2o writes translation before rotation, quaternions as qx qy qz qw, and the information matrix as its upper triangle in
that order. Here rotation comes first and the matrix is a covariance. The last three numbers of a tangent in space are
taken as a rotation vector, as GTSAM and SE-Sync read these files; g2o itself means the vector part of the quaternion,
half of that. The published optimal costs are of the former reading.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.fusion.factors import Factor
from scanloom.stages.geometry.se3 import F8, matrix_from_quaternion, pose, so3_exp

FLAT_SIGMA = 1e-3
"""Of roll, pitch (rad) and height (m) along odometry in a plane graph, which says nothing of them: they stay zero."""
IN_PLANE = (3, 4, 2)
"""Where x, y and yaw of the plane stand in a tangent of space, in g2o's order."""


@dataclass(frozen=True)
class PoseGraph:
    """Initial poses (n, 4, 4) of the file and its edges; an edge from k to k + 1 is odometry, any other a loop."""

    name: str
    nodes: F8
    factors: list[Factor]
    flat: bool

    @property
    def loops(self) -> list[Factor]:
        return [f for f in self.factors if f.kind == "loop"]

    def from_odometry(self) -> F8:
        """Poses (n, 4, 4) of odometry alone, from the first of the file on."""
        motion = {f.i: f.measurement for f in self.factors if f.kind == "odometry"}
        T = [self.nodes[0]]
        for k in range(len(self.nodes) - 1):
            T.append(T[-1] @ motion[k])
        return np.array(T)


def read(path: Path) -> PoseGraph:
    """A g2o file of SE2 or SE3:QUAT vertices and edges.

    Raises
    ------
    ValueError : a line that is neither.
    """
    nodes: dict[int, F8] = {}
    factors: list[Factor] = []
    flat = False
    for line in path.read_text().splitlines():
        tag, *words = line.split() or [""]
        if tag == "VERTEX_SE2":
            flat = True
            nodes[int(words[0])] = _flat_pose(_numbers(words[1:4]))
        elif tag == "VERTEX_SE3:QUAT":
            nodes[int(words[0])] = _pose(_numbers(words[1:8]))
        elif tag == "EDGE_SE2":
            v = _numbers(words[2:])
            factors.append(_edge(words, _flat_pose(v[:3]), flat_covariance(v[3:], _is_odometry(words))))
        elif tag == "EDGE_SE3:QUAT":
            v = _numbers(words[2:])
            factors.append(_edge(words, _pose(v[:7]), covariance(v[7:])))
        elif tag and tag != "FIX":
            raise ValueError(f"{path.name} holds {tag}, which is not read")
    return PoseGraph(path.stem, np.array([nodes[k] for k in sorted(nodes)]), factors, flat)


def information(upper: F8) -> F8:
    """Symmetric matrix (n, n) of its upper triangle, row by row."""
    n = int((np.sqrt(8 * len(upper) + 1) - 1) / 2)
    out = np.zeros((n, n))
    out[np.triu_indices(n)] = upper
    return np.asarray(out + np.triu(out, 1).T)


def covariance(upper: F8) -> F8:
    """Covariance (6, 6), order (rotation, translation), of g2o's 21 numbers of information."""
    order = np.array([3, 4, 5, 0, 1, 2])
    return np.asarray(np.linalg.inv(information(upper))[np.ix_(order, order)])


def flat_covariance(upper: F8, odometry: bool) -> F8:
    """Covariance (6, 6) of a plane edge's 6 numbers of information (x, y, yaw); what a loop does not tell is infinite."""
    out = np.diag(np.full(6, FLAT_SIGMA**2 if odometry else np.inf))
    out[np.ix_(IN_PLANE, IN_PLANE)] = np.linalg.inv(information(upper))
    return out


def _edge(words: list[str], measurement: F8, C: F8) -> Factor:
    kind = "odometry" if _is_odometry(words) else "loop"
    return Factor(kind, int(words[0]), int(words[1]), measurement, C)


def _is_odometry(words: list[str]) -> bool:
    return int(words[1]) == int(words[0]) + 1


def _numbers(words: list[str]) -> NDArray[np.float64]:
    return np.array([float(w) for w in words])


def _flat_pose(v: F8) -> F8:
    return pose(so3_exp([0.0, 0.0, v[2]]), [v[0], v[1], 0.0])


def _pose(v: F8) -> F8:
    return pose(matrix_from_quaternion(v[[6, 3, 4, 5]]), v[:3])
