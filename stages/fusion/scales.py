"""How far the stated covariances of odometry and loops hold, from the data.

Loops: variance components (Foerstner 1979; Koch, Parameter Estimation, 3.6). The sum of squares of their whitened residuals
over their redundancy, n - tr(A Sigma A^T), estimates the factor on their variances, for rotation and translation each.

Odometry: what matters for a map is not the noise of a step but how it adds up, which is rarely a random walk as stated. So it
is asked at closures: how far odometry is off between the two ends of a loop. The likelihood of all closures, C of the loop
plus s^2 C of the way, is greatest at the scale s. Loops side by side share the way and count as one.

The statement itself counts like a number of measurements that agree with it, and no scale leaves its bounds, so that a
graph with little redundancy keeps what was stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.linearization import I8
from scanloom.stages.fusion.system import System
from scanloom.stages.geometry.se3 import F8

GROUPS = ("odometry", "loop")
LOOP = GROUPS.index("loop")
BELIEF = 30.0
"""Redundancy at which residuals of loops weigh as much as the statement."""
BELIEF_CLOSURES = 6.0
"""Directions closed at which closures weigh as much as the statement of odometry."""
LOWEST, LOWEST_BESIDE_FIXES, HIGHEST = 0.5, 1.0, 3.0
"""Where fixes are in use they tell how good odometry is (see `walk`), and loops, whose errors are much alike, not even better."""
HALVES = slice(0, 3), slice(3, 6)
TAIL = 4.0
"""Degrees of freedom of the closures' distribution (Student): a loop that is itself off must not decide."""
TRIED = np.geomspace(0.01, HIGHEST, 49)
PASSES = 3
VAGUE = 5.0
"""Directions this much less certain than usual in their group are not asked: they say nothing of its scale."""


@dataclass(frozen=True)
class Scales:
    """Factors on the stated standard deviations: rows as GROUPS, columns rotation and translation."""

    value: F8
    seen: F8 = field(default_factory=lambda: np.ones(2))
    """How far odometry is really off at closures, over what these scales say (2,): below 1 at the lower bound."""

    @classmethod
    def as_stated(cls) -> Scales:
        return cls(np.ones((len(GROUPS), 2)))

    def of(self, group: I8) -> F8:
        """(m, 2) of factors of the groups (m,), -1 for those that keep what they state."""
        return np.vstack((self.value, np.ones(2)))[group]

    def change(self, other: Scales) -> float:
        """Largest relative difference."""
        return float(np.abs(self.value / other.value - 1.0).max())


def groups(factors: Sequence[Factor]) -> I8:
    """(m,) group of each factor, -1 for none."""
    return np.array([GROUPS.index(f.kind) if f.kind in GROUPS else -1 for f in factors], np.int64)


def of_loops(system: System, T: F8, weight: F8, loops: I8, now: F8) -> F8:
    """Scales (2,) of the loops in use at the optimum T (n, 4, 4) that was found with the scales `now` (2,)."""
    rows = loops[weight[loops] > 0]
    if not len(rows):
        return now
    s = system.stated
    residual, A_i, A_j = s.taken(rows).linearised(T)
    found = system.covariances(T, weight)
    Z_i, Z_j, Z_ij = found.poses[s.i[rows]], found.poses[s.j[rows]], found.across[rows]
    explained = (A_i @ Z_i * A_i).sum(2) + (A_j @ Z_j * A_j).sum(2) + 2.0 * (A_i @ Z_ij * A_j).sum(2)
    redundancy = np.clip(1.0 - explained / np.repeat(now, 3) ** 2, 0.0, 1.0)
    clear = _clear(np.diagonal(s.whitening[rows], axis1=1, axis2=2))
    new = np.ones(2)
    for half, block in enumerate(HALVES):
        told = clear[:, block]
        squares = (residual[:, block] ** 2)[told].sum()
        new[half] = np.sqrt((squares + BELIEF) / (redundancy[:, block][told].sum() + BELIEF))
    return np.asarray(np.clip(new, None, HIGHEST))


def shared(residual: F8, pairs: I8, beside: F8) -> F8:
    """Factors (m, 2) on the standard deviations of loops side by side, rotation and translation, for errors they share.

    residual : (m, 6) whitened, at the solution; pairs : (k, 2) of loops side by side; beside : (m,) how many lie beside a
    loop, itself included. Their errors' correlation rho is what the residuals of pairs show; n loops then tell as much as
    n / (1 + (n - 1) rho) independent ones (Kish, Survey Sampling, 1965: design effect).
    """
    out = np.ones((len(residual), 2))
    for half, block in enumerate(HALVES):
        r = residual[:, block]
        one, other = r[pairs[:, 0]], r[pairs[:, 1]]
        rho = 2.0 * (one * other).sum() / max((one**2 + other**2).sum(), 1e-12)
        out[:, half] = np.sqrt(1.0 + (beside - 1.0) * np.clip(rho, 0.0, 1.0))
    return out


def _clear(sharpness: F8) -> NDArray[np.bool_]:
    """Which directions (m, 6) are about as certain as usual; the others, or those not measured, tell nothing of the scale."""
    usual = np.array([np.median(c[c > 0]) if (c > 0).any() else np.inf for c in sharpness.T])
    return np.asarray(sharpness > usual / VAGUE)


def of_odometry(error: F8, C: F8, ways: tuple[F8, F8, F8], freedom: I8, share: F8) -> F8:
    """Scales (2,) of odometry's rotation and translation from closures (m,), not bounded below.

    error (m, 6) : odometry minus loop; C (m, 6, 6) : covariance of the loop; ways (3, m, 6, 6) : of the way as stated, by
    its rotations alone, by its translations alone, and by what both share; freedom : directions a loop measured; share :
    part of a count of its own that a closure has among its neighbours.
    """

    def gain(s: F8) -> float:
        whole = C + s[0] ** 2 * ways[0] + s[1] ** 2 * ways[1] + s[0] * s[1] * ways[2]
        square = np.einsum("ni,ni->n", error, np.linalg.solve(whole, error[..., None])[..., 0])
        likelihood = -0.5 * np.linalg.slogdet(whole)[1] - 0.5 * (TAIL + freedom) * np.log1p(square / TAIL)
        return float(share @ likelihood - 0.5 * BELIEF_CLOSURES * (np.log(s) + 0.5 / s**2).sum())

    best = np.ones(2)
    for half in (0, 1) * PASSES:
        tried = np.tile(best, (len(TRIED), 1))
        tried[:, half] = TRIED
        best = tried[int(np.argmax([gain(s) for s in tried]))]
    return best
