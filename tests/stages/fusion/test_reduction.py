"""A long graph made short gives the same answer."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.city import city
from scanloom.stages.fusion import solving
from scanloom.stages.fusion.consistency import chain
from scanloom.stages.fusion.factors import BETWEEN
from scanloom.stages.fusion.reduction import Reduction, worthwhile
from scanloom.stages.fusion.solving import solve
from scanloom.stages.fusion.system import System


def test_the_same_loops_and_poses_as_on_the_whole_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    solved = []
    for many in (10_000, 1_000):
        monkeypatch.setattr(solving, "MANY", many)
        nodes, factors, genuine, true = city(3000, blocks=4, seed=3)
        T = solve(nodes, factors, 0.999).T
        used = np.array([not f.verdict for f in factors if f.kind == "loop"])
        assert not (used & ~genuine).any()
        assert used[genuine].mean() > 0.8
        solved.append((T, used, true))
    (whole, used, true), (short, also, _) = solved
    assert (used == also).mean() > 0.9
    apart = np.sqrt(np.mean(np.sum((whole - short)[:, :3, 3] ** 2, axis=1)))
    error = np.sqrt(np.mean(np.sum((whole - true)[:, :3, 3] ** 2, axis=1)))
    assert 0.0 < apart < 0.5 * error


def test_what_is_kept_comes_back_and_stretches_keep_their_shape() -> None:
    nodes, factors, _, _ = city(2000, blocks=4)
    stack = System(len(nodes), factors).stack
    loops = np.flatnonzero([f.kind == "loop" for f in factors])
    steps = np.flatnonzero((stack.shape == BETWEEN) & (stack.j == stack.i + 1))
    covariance = np.array([factors[k].covariance for k in steps])
    way = chain(len(nodes), stack.i[steps], stack.measurement[steps], covariance)
    short = Reduction.of(stack, way, loops)
    ends = np.unique(np.concatenate((stack.i[loops], stack.j[loops], [0, 1999])))
    assert np.array_equal(short.kept, ends)
    assert len(short.factors(factors)) == len(short.kept) - 1 + len(loops) + 1
    np.testing.assert_allclose(short.spread(nodes[short.kept]), nodes, atol=1e-6)
    longest = int(np.argmax(np.diff(short.kept)))
    moved = nodes[short.kept].copy()
    moved[longest + 1 :, 0, 3] += 1.0
    off = np.linalg.norm((short.spread(moved) - nodes)[:, :3, 3], axis=1)
    a, b = short.kept[longest : longest + 2]
    step = np.diff(off[a : b + 1])
    assert 0.5 / (b - a) < step.min()
    assert step.max() < 2.0 / (b - a), "what a stretch lacks is shared out evenly"


def test_short_and_dense_graphs_stay_whole() -> None:
    assert worthwhile(100, np.arange(50), 100)
    assert not worthwhile(100, np.arange(51), 100)
    assert not worthwhile(99, np.arange(10), 100)
