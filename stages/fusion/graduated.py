"""Graduated non-convexity with the truncated least-squares cost (Yang, Antonante, Tzoumas, Carlone, RA-L 2020).

The cost of a doubted factor turns from a parabola into one that is cut off at its limit, in steps; between them the poses
follow. Weights at a step mu: 1 for squares up to mu/(mu+1) of the limit, 0 from (mu+1)/mu on, between them
sqrt(limit/square mu (mu+1)) - mu.
"""

from __future__ import annotations

import numpy as np

from scanloom.stages.fusion.linearization import I8
from scanloom.stages.fusion.system import System
from scanloom.stages.geometry.se3 import F8

STEP = 2.0
FIRST = 1e-3
"""A start nearer to the parabola than this gives the same answer later."""
LAST = 1e4
COARSE_ITERATIONS, COARSE_TOLERANCE = 6, 1e-5
CHECKS = 10


def graduated(system: System, T: F8, weight: F8, doubted: I8, limit: F8, *, loose: bool = False) -> F8:
    """Poses (n, 4, 4) from T on; sets the weights (m,) of the `doubted` factors in place to 0 or 1.

    limit : (m,) chi-square from which a factor is an outlier.
    """
    weight[doubted] = 1.0
    if len(doubted):
        T = system.optimised(T, weight, loose=loose, tolerance=1e-4)
        square = system.squares(T)[doubted]
        if (square > limit[doubted]).any():
            T = _tightened(system, T, weight, doubted, limit, loose)
    return checked(system, T, weight, doubted, limit, loose=loose)


def _tightened(system: System, T: F8, weight: F8, doubted: I8, limit: F8, loose: bool) -> F8:
    square = system.squares(T)[doubted]
    worst = 2.0 * square / limit[doubted] - 1.0
    mu = max(1.0 / float(worst[worst > 0].max()), FIRST)
    while mu < LAST:
        weight[doubted] = _weights(mu, square, limit[doubted])
        T = system.optimised(T, weight, loose=loose, iterations=COARSE_ITERATIONS, tolerance=COARSE_TOLERANCE)
        square = system.squares(T)[doubted]
        settled = _weights(mu, square, limit[doubted])
        if ((settled < 1e-3) | (settled > 1 - 1e-3)).all():
            break
        mu *= STEP
    weight[doubted] = square <= limit[doubted]
    return T


def checked(system: System, T: F8, weight: F8, doubted: I8, limit: F8, *, loose: bool = False) -> F8:
    """Solve with weights of 0 and 1, taking out what does not pass, until all that is in use passes."""
    weight[doubted] = (weight[doubted] > 0.5).astype(float)
    for _ in range(CHECKS):
        T = system.optimised(T, weight, loose=loose)
        fails = (system.squares(T)[doubted] > limit[doubted]) & (weight[doubted] > 0)
        if not fails.any():
            return T
        weight[doubted[fails]] = 0.0
    return system.optimised(T, weight, loose=loose)


def _weights(mu: float, square: F8, limit: F8) -> F8:
    between = np.sqrt(limit / np.maximum(square, 1e-300) * mu * (mu + 1.0)) - mu
    return np.where(
        square <= mu / (mu + 1.0) * limit, 1.0, np.where(square >= (mu + 1.0) / mu * limit, 0.0, between)
    )
