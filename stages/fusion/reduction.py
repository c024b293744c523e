"""A long graph made short: stretches of odometry on which nothing else hangs become one motion each.

Which loops are true is the same question on the short graph: motions and covariances of its stretches are added up exactly to
first order, as between the ends of loops everywhere else. All poses come back for the last solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.fusion.consistency import Chain
from scanloom.stages.fusion.factors import BETWEEN, Factor
from scanloom.stages.fusion.linearization import I8, Stack
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, se3_log


@dataclass(frozen=True)
class Reduction:
    """Nodes `kept` (k,) of a graph, increasing, and rows (m,) of its factors that stay as they are."""

    way: Chain
    kept: I8
    rows: I8

    @classmethod
    def of(cls, stack: Stack, way: Chain, loops: I8) -> Reduction:
        """Keep ends of loops and of unbroken stretches, and nodes that anything but a step of odometry speaks of."""
        steps = (stack.shape == BETWEEN) & (stack.j == stack.i + 1)
        steps[loops] = False
        rest = np.flatnonzero(~steps)
        new = np.flatnonzero(np.diff(way.part, prepend=-1, append=-1))
        ends = np.concatenate((new[:-1], new[1:] - 1, stack.i[rest], stack.j[rest]))
        return cls(way, np.unique(ends[ends >= 0]), rest)

    def __len__(self) -> int:
        return len(self.kept)

    def factors(self, factors: Sequence[Factor]) -> list[Factor]:
        """Of the short graph: one motion per stretch, then those of `rows`, renumbered copies."""
        a, b = self.kept[:-1], self.kept[1:]
        joined = np.flatnonzero(self.way.part[a] == self.way.part[b])
        Z, C = self.way.motions(a[joined], b[joined])
        short = [Factor("odometry", int(k), int(k) + 1, z, c) for k, z, c in zip(joined, Z, C, strict=True)]
        return short + [self._renumbered(factors[row]) for row in self.rows]

    def spread(self, T: F8) -> F8:
        """Poses of all nodes (n, 4, 4) from those of the kept ones (k, 4, 4): odometry, with what a stretch lacks shared out."""
        every = np.arange(len(self.way.T))
        at = np.clip(np.searchsorted(self.kept, every, side="right") - 1, 0, max(len(self.kept) - 2, 0))
        a, b = self.kept[at], self.kept[np.minimum(at + 1, len(self.kept) - 1)]
        out = T[at] @ inverse(self.way.T[a]) @ self.way.T
        one = self.way.part[a] == self.way.part[b]
        end = T[at] @ inverse(self.way.T[a]) @ self.way.T[b]
        lacking = np.where(one[:, None], se3_log(inverse(end) @ T[np.minimum(at + 1, len(T) - 1)]), 0.0)
        share = (every - a) / np.maximum(b - a, 1)
        out = out @ se3_exp(share[:, None] * lacking)
        out[self.kept] = T
        return np.asarray(out)

    def _renumbered(self, f: Factor) -> Factor:
        i, j = (int(np.searchsorted(self.kept, k)) if k >= 0 else -1 for k in (f.i, f.j))
        return Factor(f.kind, i, j, f.measurement, f.covariance, "", f.arm_m, f.weight)


def worthwhile(n: int, kept: NDArray[np.int64], least: int) -> bool:
    """Whether a graph of n nodes is long enough, and becomes short enough."""
    return n >= least and 2 * len(kept) <= n
