"""Weights of the evidence for particles, as log-odds: logistic regressions fitted to simulated snow, dust, spray, clear air.

The bins are those of `airborne`. FIRST judges a point by itself, as anything in the air; FLAKE and CLOUD, snow, rain and spray or dust, together with what is
said of the points around it.
"""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8

BINS = 32
NEVER = -30.0
SHARES = np.array([0.025, 0.046])
"""Shares of flakes and of clouds among all points of the scans that the weights were fitted to."""


def _table(*kinds: list[float], unknown_strength: float) -> F8:
    """(kinds, BINS), filled up with zeros; the last bins of the first two: no intensities; solid by other evidence."""
    out = np.zeros((len(kinds), BINS))
    for row, kind in zip(out, kinds, strict=True):
        row[: len(kind)] = kind
    out[0, -1], out[1, -1] = unknown_strength, NEVER
    return out


# fmt: off
FIRST = _table(
    # strength over the usual one
    [2.1, 0.1, -0.2, 0.2, 0.3, 0.3, 0.3, 0.7, 0.3, -0.6, -1.8, -0.7, 0.0, 0.0],
    # shape: lines through the point, points around it
    [2.6, 1.7, 1.1, 0.3, -0.4, 2.3, 2.0, 2.1, 2.3, 1.9, 1.5, 1.0, -0.1, 0.4, -0.2,
     0.7, -0.3, -0.9, -2.1, -1.5, -0.2, -0.7, -1.7, -1.0, -1.4, 0.0, -0.3, -2.3, -3.5, -3.8],
    # range
    [2.6, 2.1, 0.4, -0.7, -4.5],
    # on the ground
    [2.2, -2.6],
    # scans nearby: met again, seen through
    [0.9, 0.5, 0.0, 0.2, 2.0, 0.9, 0.1, -0.1, 0.3, 1.4, 0.2, 0.1, -0.4, 0.0, 0.3,
     0.2, 0.0, -0.6, -0.5, -0.7, -0.6, -0.7, -1.2, -1.1, -1.5],
    # scans farther off: met again, seen through
    [-0.2, 0.4, 1.1, 0.6, 0.6, 0.3, 0.7, 1.6, 0.6, 1.2, -0.6, 0.4, 0.9, 1.1, 0.4,
     -0.6, -0.4, 0.5, 0.1, -0.1, -2.6, -1.8, -1.8, -1.1, -1.6],
    # constant
    [-4.0],
    unknown_strength=-1.4,
)

FLAKE = _table(
    # strength over the usual one
    [3.8, 2.5, 1.3, 0.8, 0.2, -0.3, -0.7, -0.7, -1.4, -1.4, -2.0, -2.3, 0.0, 0.0],
    # shape: lines through the point, points around it
    [2.5, 1.4, 0.5, 0.8, 0.0, 2.4, 1.4, 1.3, 2.3, 2.0, 0.9, 0.0, -1.5, -1.0, -0.3,
     0.1, -0.3, -1.2, -2.6, -1.8, 0.0, -0.1, -0.8, -0.3, -1.0, 0.0, -0.5, -1.0, -1.2, -1.9],
    # range
    [1.3, 1.6, 0.8, -0.7, -3.0],
    # on the ground
    [1.6, -1.6],
    # scans nearby: met again, seen through
    [-0.2, 0.5, 0.8, 1.5, 2.9, 0.0, 0.0, 0.4, 1.0, 2.0, -0.8, -0.4, -0.5, 0.3, 0.7,
     -0.8, -0.9, -1.0, -0.6, -0.4, -1.4, -0.9, -1.1, -0.6, -0.2],
    # scans farther off: met again, seen through
    [-1.2, 0.4, 0.6, 1.1, 1.7, 0.0, 0.0, 0.8, 0.8, 1.4, -1.1, -0.1, 0.1, 1.0, 0.4,
     -0.5, -0.2, 0.1, 0.0, 0.1, -1.8, -0.8, -0.8, -1.0, -1.0],
    # constant
    [-6.5],
    unknown_strength=0.1,
)

CLOUD = _table(
    # strength over the usual one
    [-2.3, -2.8, -0.7, 0.7, 1.0, 1.2, 1.0, 1.3, 1.0, 0.5, -0.4, 0.1, 0.0, 0.0],
    # shape: lines through the point, points around it
    [2.3, 1.6, 0.9, -0.1, -0.3, 2.3, 1.7, 1.6, 1.5, 1.8, 1.4, 0.8, -0.3, -0.2, -0.3,
     0.4, 0.0, -1.0, -1.7, -1.4, 0.0, -0.4, -1.2, -1.2, -1.0, 0.0, -0.1, -1.8, -2.8, -2.8],
    # range
    [1.0, 1.2, 0.3, 0.3, -2.8],
    # on the ground
    [1.3, -1.5],
    # scans nearby: met again, seen through
    [0.6, 0.4, -0.1, -0.4, 1.2, 0.5, 0.0, -0.1, 0.3, 1.3, -0.1, -0.1, -0.3, 0.0, 0.3,
     0.3, -0.1, -0.3, -0.3, -0.3, -0.1, -0.4, -0.7, -0.6, -1.2],
    # scans farther off: met again, seen through
    [0.1, 0.1, 0.5, -0.1, -0.2, 0.4, 0.4, 1.0, 0.0, 0.6, -0.1, 0.3, 0.7, 0.7, 0.3,
     0.0, -0.1, 0.6, -0.1, 0.0, -1.4, -1.0, -1.0, -0.7, -1.0],
    # constant
    [-3.4],
    unknown_strength=-0.6,
)

CONTEXT_FLAKE = np.array(
    # no points around; then by their mean, from solid to airborne, in fours by how many they are
    [1.0,
     -0.5, 0.1, 1.3, 2.2, -0.8, -0.6, 0.4, 0.7, -0.9, -0.8, 0.2, 0.2,
     -1.2, -0.8, -0.7, -0.9, -1.1, -1.3, -0.9, -1.2, -0.8, -0.7, -1.3, -1.3,
     0.0, -0.1, -1.0, -1.0, 0.7, 0.1, -0.7, -0.7, 1.7, 1.0, -0.2, 0.0,
     2.0, 0.9, -0.1, 0.0, 2.2, 1.2, 0.3, 0.1, 2.2, 1.2, 0.0, 0.0]
)
CONTEXT_CLOUD = np.array(
    # no points around; then by their mean, from solid to airborne, in fours by how many they are
    [-0.6,
     -2.8, -3.5, -2.9, -2.5, -2.4, -3.4, -2.8, -2.1, -2.5, -3.2, -2.5, -1.3,
     -2.6, -2.7, -2.1, -0.7, -2.6, -2.3, -1.2, 0.5, -2.3, -1.1, -0.3, 1.4,
     -0.7, 0.7, 1.4, 2.8, 0.6, 1.7, 2.3, 3.6, 1.4, 2.3, 3.0, 4.4,
     1.8, 2.5, 3.1, 3.7, 2.0, 2.4, 2.5, 2.1, 1.9, 1.6, 1.0, 0.2]
)
# fmt: on
