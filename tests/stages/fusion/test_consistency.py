"""Which loops come into use: true ones, not false ones that agree with each other, alone or in a crowd."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.fusion.consistency import Agreement, alone_among, contradicting
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.solving import solve
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, so3_exp
from tests.stages.fusion.drives import ate

N, STEP_M = 400, 2.0
ODOMETRY = np.repeat([np.radians(0.07), 0.03], 3)
LOOP = np.repeat([np.radians(0.2), 0.05], 3)


def truth() -> F8:
    """Two laps of 400 m round a ring."""
    angle = np.arange(N) * STEP_M / 400.0 * 2 * np.pi
    radius = 400.0 / (2 * np.pi)
    at = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), 0 * angle))
    return pose(so3_exp(np.column_stack((0 * angle, 0 * angle, angle + np.pi / 2))), at)


def drive(seed: int) -> tuple[F8, F8, list[Factor]]:
    """Truth, start from odometry, and odometry with a prior."""
    rng, T = np.random.default_rng(seed), truth()
    motion = inverse(T[:-1]) @ T[1:] @ se3_exp(rng.normal(size=(N - 1, 6)) * ODOMETRY)
    start = [T[0]]
    for m in motion:
        start.append(start[-1] @ m)
    factors = [Factor("odometry", k, k + 1, m, np.diag(ODOMETRY**2)) for k, m in enumerate(motion)]
    return T, np.array(start), [*factors, Factor("prior", 0, -1, T[0], np.eye(6) * 1e-6)]


def true_loops(T: F8, seed: int) -> list[Factor]:
    rng = np.random.default_rng(seed + 100)
    noise = se3_exp(rng.normal(size=(N, 6)) * LOOP)
    return [Factor("loop", k, k + 200, inverse(T[k]) @ T[k + 200] @ noise[k], np.diag(LOOP**2)) for k in range(0, 200, 8)]  # fmt: skip


def crowd(i: int, j: int, seed: int) -> list[Factor]:
    """20 loops side by side that say with one voice that two far places are the same: a street that looks alike."""
    rng = np.random.default_rng(seed + 200)
    return [Factor("loop", i + k, j + k, se3_exp(rng.normal(size=6) * LOOP), np.diag(LOOP**2)) for k in range(20)]  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_true_loops_are_used_and_a_crowd_of_false_ones_is_not(seed: int) -> None:
    T, start, factors = drive(seed)
    true, false = true_loops(T, seed), crowd(20, 130, seed)
    solution = solve(start, [*factors, *false, *true], 0.999)
    assert sum(not f.verdict for f in true) >= len(true) - 1
    assert all(f.verdict for f in false)
    assert 0.01 < ate(solution.T, T) < 0.6 * ate(start, T)


@pytest.mark.parametrize("seed", range(3))
def test_a_crowd_of_false_loops_alone_does_not_bend_the_map(seed: int) -> None:
    _, start, factors = drive(seed)
    false = crowd(20, 130, seed)
    solution = solve(start, [*factors, *false], 0.999)
    assert all(f.verdict for f in false)
    np.testing.assert_allclose(solution.T, start, atol=1e-6)


def test_a_lone_loop_is_used_only_where_odometry_can_vouch_for_it() -> None:
    T, start, factors = drive(0)
    near = Factor("loop", 10, 40, inverse(T[10]) @ T[40], np.diag(LOOP**2))
    solve(start, [*factors, near], 0.999)
    assert near.verdict == ""
    wide = [Factor("odometry", f.i, f.j, f.measurement, f.covariance * 400.0) for f in factors[:-1]]
    far = Factor("loop", 10, 210, inverse(T[10]) @ T[210], np.diag(LOOP**2))
    solve(start, [*wide, factors[-1], far], 0.999)
    assert far.verdict == "no other loop confirms it"


def test_of_contradicting_loops_the_one_with_fewer_friends_goes() -> None:
    found = Agreement(
        np.array([[0, 1], [0, 2], [1, 2], [0, 3], [2, 3]]), np.array([True, True, True, False, False])
    )
    gone = contradicting(5, found)
    np.testing.assert_array_equal(gone, [False, False, False, True, False])
    np.testing.assert_array_equal(alone_among(5, found, gone), [False, False, False, True, True])
