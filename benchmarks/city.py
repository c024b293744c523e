"""A city of 100,000 poses with one per cent of loops, a fifth of them false: does it solve, how fast, in how much memory.

A walk over a grid of streets without GNSS; odometry drifts as its covariances say; false loops come in runs that agree with
each other. Each size is solved in a process of its own, whose peak memory is told.

    python -m benchmarks.city 100000        one size, figures as JSON
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.scores import Figure
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.solving import solve
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, so3_exp

SIZE = 100_000
STEP_M, BLOCK_M, BLOCKS = 2.0, 100.0, 16
ODOMETRY_STD = np.repeat([np.radians(0.05), 0.02], 3) * np.sqrt(STEP_M)
LOOP_STD = np.repeat([np.radians(0.2), 0.1], 3)
NEAR_M, APART = 6.0, 500
"""Loops join poses this near that lie so many poses apart."""
RUN = 5
"""False loops that agree with each other."""


def figures() -> Iterator[Figure]:
    """Of the large city, solved in a fresh process."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.city", str(SIZE)], check=True, capture_output=True, text=True
    )
    yield from (Figure(**row) for row in json.loads(done.stdout))


def measured(size: int) -> list[Figure]:
    """Solve once for the compilation of kernels, then the city."""
    solve(*city(6000, blocks=4)[:2], 0.999)
    nodes, factors, genuine, true = city(size)
    started = time.monotonic()
    solution = solve(nodes, factors, 0.999)
    wall_s = time.monotonic() - started
    used = np.array([not f.verdict for f in factors if f.kind == "loop"])
    error = np.linalg.norm(solution.T[:, :3, 3] - true[:, :3, 3], axis=1)
    prefix, how = (
        f"synthetic_{size // 1000}k",
        f"{size} poses, {len(used)} loops, {(~genuine).sum()} of them false",
    )
    rows = (
        ("wall_s", wall_s, "s", "consistency, optimum and all marginals"),
        ("peak_rss_mb", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, "MB", "peak memory of the process"),
        ("false_loops_used", float((used & ~genuine).sum()), "", "false loops in the solution"),
        ("true_loops_used_share", float(used[genuine].mean()), "", "share of true loops in the solution"),
        ("rmse_m", float(np.sqrt((error**2).mean())), "m", "distance to truth, the first pose held"),
    )  # fmt: skip
    return [
        Figure(f"{prefix}.{name}", value, unit, "run", f"{what}; {how}") for name, value, unit, what in rows
    ]


def city(
    size: int, *, loops: float = 0.01, false: float = 0.2, seed: int = 0, blocks: int = BLOCKS
) -> tuple[F8, list[Factor], np.ndarray, F8]:
    """Initial poses (n, 4, 4), factors, which loops are genuine (m,), true poses (n, 4, 4)."""
    rng = np.random.default_rng(seed)
    T = _walk(rng, size, blocks)
    motion = inverse(T[:-1]) @ T[1:] @ se3_exp(rng.normal(size=(size - 1, 6)) * ODOMETRY_STD)
    covariance = np.diag(ODOMETRY_STD**2)
    factors = [Factor("odometry", k, k + 1, motion[k], covariance) for k in range(size - 1)]
    wrong = int(size * loops * false)
    right = _genuine(rng, T, int(size * loops) - wrong)
    factors += [*right, *_false(rng, size, wrong), Factor("prior", 0, -1, T[0], np.eye(6) * 1e-6)]
    nodes = [T[0]]
    for step in motion:
        nodes.append(nodes[-1] @ step)
    return np.array(nodes), factors, np.arange(len(right) + wrong) < len(right), T


def _walk(rng: np.random.Generator, size: int, blocks: int) -> F8:
    """Poses every STEP_M of a walk that never turns back and stays in the city."""
    at, heading, places, headings = np.zeros(2), 0, [], []
    ahead = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    way = np.arange(0.0, BLOCK_M, STEP_M)
    while len(places) * len(way) < size:
        places.append(at + way[:, None] * ahead[heading % 4])
        headings.append(np.full(len(way), heading * np.pi / 2))
        at = at + BLOCK_M * ahead[heading % 4]
        open_ = [
            h for h in (heading, heading + 1, heading - 1)
            if (np.abs(at + BLOCK_M * ahead[h % 4]) <= blocks * BLOCK_M / 2 + 1).all()
        ]  # fmt: skip
        heading = int(rng.choice(open_))
    xy, yaw = np.concatenate(places)[:size], np.concatenate(headings)[:size]
    z = 3.0 * np.sin(xy[:, 0] / 200) * np.cos(xy[:, 1] / 150)
    return pose(so3_exp(np.column_stack((0 * yaw, 0 * yaw, yaw))), np.column_stack((xy, z)))


def _genuine(rng: np.random.Generator, T: F8, count: int) -> list[Factor]:
    from scipy.spatial import cKDTree

    pairs = cKDTree(T[:, :2, 3]).query_pairs(NEAR_M, output_type="ndarray")
    pairs = pairs[np.abs(pairs[:, 1] - pairs[:, 0]) > APART]
    chosen = pairs[rng.choice(len(pairs), count, replace=False)]
    return [_loop(rng, int(a), int(b), inverse(T[a]) @ T[b]) for a, b in np.sort(chosen, axis=1)]


def _false(rng: np.random.Generator, size: int, count: int) -> list[Factor]:
    out: list[Factor] = []
    while len(out) < count:
        i, j = np.sort(rng.choice(size - 4 * RUN, 2, replace=False))
        shown = se3_exp(rng.normal(size=6) * np.repeat([0.05, 2.0], 3))
        out += [_loop(rng, int(i + 2 * k), int(j + 2 * k), shown) for k in range(min(RUN, count - len(out)))]
    return out


def _loop(rng: np.random.Generator, i: int, j: int, T_i_j: F8) -> Factor:
    return Factor("loop", i, j, T_i_j @ se3_exp(rng.normal(size=6) * LOOP_STD), np.diag(LOOP_STD**2))


if __name__ == "__main__":
    print(json.dumps([figure.row() for figure in measured(int(sys.argv[1]))]))
