"""Bicocca 2009-02-25b: 446 loops by appearance in a plane graph of 8358 poses, many of them false."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import peers, pose_graphs
from benchmarks.scores import Figure
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.solving import solve
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.se3 import F8

FILE = "B25b_0.000.g2o"
FILTERED = "B25b_0.500.g2o"
TRUTH, STAMPS = "Bicocca_2009-02-25b-GT-extended.csv", "B25b_timestamps.txt"
PROBABILITY = 0.999


@dataclass(frozen=True)
class Truth:
    """Positions (m, 2) at the graph's poses `rows` (m,), interpolated in time."""

    rows: NDArray[np.int64]
    position: F8

    def ate_m(self, T: F8) -> float:
        """Root mean square distance after the best rigid motion in the plane."""
        true, estimate = np.tile(np.eye(4), (2, len(self.rows), 1, 1))
        true[:, :2, 3], estimate[:, :2, 3] = self.position, T[self.rows, :2, 3]
        return alignment.rms(alignment.absolute_errors(true, estimate))


def truth(folder: Path) -> Truth:
    """The rows of the file are x, y, yaw of the robot by stamp; poses outside its time are left out."""
    rows = np.loadtxt(folder / TRUTH, delimiter=",")
    stamp = np.loadtxt(folder / STAMPS)
    known = np.flatnonzero((stamp >= rows[0, 0]) & (stamp <= rows[-1, 0]))
    at = [np.interp(stamp[known], rows[:, 0], rows[:, axis]) for axis in (1, 2)]
    return Truth(known, np.column_stack(at))


def ours(path: Path) -> tuple[F8, list[Factor]]:
    """The product's solver from odometry on: poses (n, 4, 4), and factors with verdicts."""
    graph = pose_graphs.read(path)
    start = graph.from_odometry()
    factors = [*graph.factors, Factor("prior", 0, -1, start[0], np.eye(6) * 1e-6)]
    return solve(start, factors, PROBABILITY).T, factors


def figures(path: Path) -> Iterator[Figure]:
    """ATE of every method with all loops, and of odometry alone."""
    known = truth(path.parent)
    whole = "rms over the whole path after rigid alignment in the plane"
    for method in peers.METHODS:
        started = time.monotonic()
        T = peers.solve(method, path, flat=True)
        yield from _row(f"all_loops.{method}", known.ate_m(T), time.monotonic() - started, whole)
    odometry = pose_graphs.read(path).from_odometry()
    yield Figure("bicocca.odometry.ate_rmse_m", known.ate_m(odometry), "m", "map", f"no loops; {whole}")
    filtered = peers.solve("least_squares", path.parent / FILTERED, flat=True)
    by_hand = f"loops thresholded by their authors, plain least squares; {whole}"
    yield Figure(
        "bicocca.filtered_loops.least_squares.ate_rmse_m", known.ate_m(filtered), "m", "map", by_hand
    )
    started = time.monotonic()
    T, factors = ours(path)
    yield from _row("all_loops", known.ate_m(T), time.monotonic() - started, f"this solver; {whole}")
    used = sum(f.kind == "loop" and not f.verdict for f in factors)
    yield Figure("bicocca.all_loops.used", used, "", "map", "loops of 446 that this solver keeps")


def _row(name: str, ate_m: float, wall_s: float, how: str) -> Iterator[Figure]:
    yield Figure(f"bicocca.{name}.ate_rmse_m", ate_m, "m", "map", how)
    yield Figure(f"bicocca.{name}.wall_s", wall_s, "s", "run", "reading and solving")
