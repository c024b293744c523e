"""Weights of the final evidence for particles, as log-odds: logistic regressions fitted to simulated snow, dust, clear air.

One table for each round; the bins are those of `airborne`.
"""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8

BINS = 36


def _table(kinds: list[list[float]]) -> F8:
    """(kinds, BINS), filled up with zeros."""
    out = np.zeros((len(kinds), BINS))
    for row, kind in zip(out, kinds, strict=True):
        row[: len(kind)] = kind
    return out


# fmt: off
FIRST = _table([
    # class by denoise (solid, dynamic, airborne, outlier), each with its place unknown, standing, gone
    [-0.7, 0.0, 1.3, -0.1, -1.2, 0.0, 1.2, -1.6, -0.1, 0.4, -1.1, -0.9],
    # share of its thing in the air, in fives by the size of the thing
    [1.1, 0.0, -0.5, -0.4, -0.9, 0.0, 0.0, -1.0, -1.7, -0.4, 0.0, -1.3, -0.9, -0.2, 0.9, 0.0, -0.6,
     -0.9, -0.3, 1.9, 0.0, -0.3, -0.6, 0.0, 0.1, 0.0, 0.0, -0.2, 0.6, 0.5, 1.2, 0.2, 0.4, 0.5, 0.1],
    # share of what lies around that is solid, in fours by how much that is
    [0.6, -0.8, 0.9, 2.2, 0.0, 0.0, -0.2, 2.7, 0.0, -2.2, -1.0, 2.0, 0.0, -2.5, -1.6, 0.6, 0.0, -1.9,
     -1.1, -0.3],
    # share of what lies around that is in the air, each for the four classes
    [-1.8, -1.2, -0.9, -1.4, 0.3, -0.3, -0.3, -0.1, 0.6, 0.0, -0.1, 0.0, 0.6, -0.1, -0.1, 0.0, 0.9,
     0.4, 0.8, -0.2],
    # range, each by its thing: not, partly, mostly in the air
    [0.1, -4.4, 2.5, 0.4, -2.5, 1.6, 0.0, 1.0, 1.1, 0.1, 1.4, -0.3, -1.4, 0.0, -2.5],
    # share of the moving box around it in the air; in no box; beside one
    [-3.2, -2.6, -1.8, -1.1, -0.3, 1.6, 2.7, 1.9],
    # share of its thing that went, each for few and many returns
    [-0.7, -2.2, 0.5, -0.4, 0.6, 0.4, 0.1, -1.0],
    # share of the scan in the air
    [-2.7, -0.4, -0.3, -0.4, 0.0, 0.8, 0.4],
    # strength over that of bright things that stand; not known
    [2.0, 1.1, 0.8, 0.6, 0.7, 1.1, 1.0, 0.6, 0.7, -0.1, -1.2, -2.5, -3.5, -4.2, 0.2],
    # how much is seen beyond, in fives by range
    [-2.2, -1.1, 0.2, -0.4, -2.3, -0.3, -0.1, 0.2, -0.3, -1.8, -1.5, -0.6, 0.0, -0.1, -0.6, 0.0, 0.1,
     0.6, 0.7, 0.6, 2.3, 1.1, 1.1, 1.4, 0.2],
    # constant
    [-3.6],
])

SECOND = _table([
    # class by denoise (solid, dynamic, airborne, outlier), each with its place unknown, standing, gone
    [-0.4, 0.0, 1.0, -0.2, -1.1, -0.1, 1.2, -2.1, 0.1, 0.7, -1.1, 0.0],
    # share of its thing in the air, in fives by the size of the thing
    [1.5, 0.4, -0.2, -1.3, -2.6, 0.0, 0.0, -0.5, 0.1, -2.5, 0.0, -0.9, -0.6, 0.7, 0.1, 0.0, -0.7, -0.5,
     0.8, 0.0, 0.0, -0.2, -1.0, -0.4, 0.6, 0.0, 0.0, -0.1, 0.3, 1.1, 1.0, 0.1, 0.7, 0.9, 1.1],
    # share of what lies around that is solid, in fours by how much that is
    [1.2, -1.0, 0.2, 1.1, 0.0, 0.0, -0.4, 1.4, 0.0, -1.6, -0.8, 1.4, 0.0, -1.7, -1.1, 0.5, 0.0, -1.0,
     -0.4, 0.0],
    # share of what lies around that is in the air, each for the four classes
    [-2.5, -3.0, -1.4, -2.0, -0.2, -1.0, -0.6, 0.0, 0.6, 0.8, -0.3, 0.1, 1.1, 0.4, 0.0, 0.3, 1.7, 1.4,
     1.5, 1.2],
    # range, each by its thing: not, partly, mostly in the air
    [0.3, -1.8, 1.9, 0.5, -3.3, 1.8, -0.2, 0.1, 1.2, -0.7, 1.3, 0.1, -2.1, -0.3, -0.8],
    # share of the moving box around it in the air; in no box; beside one
    [-0.3, -1.6, -2.2, -1.0, 0.0, 0.5, 1.4, 1.2],
    # share of its thing that went, each for few and many returns
    [-0.3, -1.3, 0.6, -0.6, 0.6, -0.2, 0.2, -1.1],
    # share of the scan in the air
    [-3.8, -0.5, -0.1, 0.2, 0.6, 0.9, 0.6],
    # strength over that of bright things that stand; not known
    [1.8, 1.0, 0.8, 0.6, 0.5, 0.9, 0.9, 0.6, 0.6, -0.1, -1.0, -2.1, -3.0, -3.7, 0.2],
    # how much is seen beyond, in fives by range
    [-1.5, -1.2, -0.1, -0.5, -2.4, 0.1, -0.2, 0.0, -0.4, -1.6, -1.0, -0.5, -0.2, -0.2, -0.3, 0.4, 0.0,
     0.4, 0.5, 0.9, 2.5, 0.9, 0.9, 1.2, 0.3],
    # constant
    [-2.9],
])
# fmt: on
ROUNDS = (FIRST, SECOND)
