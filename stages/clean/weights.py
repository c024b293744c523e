"""Weights of the final evidence for particles, as log-odds: logistic regressions fitted to simulated snow, dust, clear air.

One table for each round; the bins are those of `signs`.
"""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8

BINS = 80


def _table(kinds: list[list[float]]) -> F8:
    """(kinds, BINS), filled up with zeros."""
    out = np.zeros((len(kinds), BINS))
    for row, kind in zip(out, kinds, strict=True):
        row[: len(kind)] = kind
    return out


# fmt: off
FIRST = _table([
    # class by denoise (solid, dynamic, airborne, outlier, ground), each with its place unknown, standing, gone
    [0.0, -1.7, 1.2, 0.0, -1.3, 0.7, 0.9, -1.2, -0.5, 0.7, -0.4, -0.9, 0.1, 0.0, 0.0],
    # share of its thing in the air, in fives by the size of the thing
    [1.1, 0.5, -0.1, -0.5, -1.9, 0.0, 0.0, -0.5, -1.5, -1.5, 0.0, -1.3, -0.5, 0.1, 1.1, 0.0, -0.6, -0.8,
     0.3, 2.0, 0.0, -0.1, -0.8, -0.4, 0.4, 0.0, 0.0, -0.3, 0.6, 0.6, 1.1, 0.3, 0.1, 0.3, -0.1],
    # share of what lies around that is solid, in fours by how much that is
    [0.7, -1.6, 0.0, 1.3, 0.0, 0.0, -0.4, 1.9, 0.0, -1.8, -0.7, 1.5, 0.0, -1.9, -1.0, 0.8, 0.0, -0.9, -0.4,
     0.1],
    # share of what lies around that is in the air, in fives by class
    [-1.6, -2.0, -0.7, -0.8, 0.8, 0.6, -0.3, 0.3, 0.1, -0.8, -0.4, 0.5, -0.6, -0.1, -0.5, 0.0, 0.6, -0.4,
     0.1, 0.2, 0.9, 0.6, 0.7, 0.2, 0.5],
    # range, each by its thing: not, partly, mostly in the air
    [0.7, -3.3, 2.4, 0.3, -2.2, 1.6, -0.2, 1.0, 0.6, -0.5, 1.4, -0.7, -1.4, 0.0, -2.2],
    # share of the moving box around it in the air; in no box; beside one; each by whether denoise has it airborne
    [-2.6, -2.0, -2.0, -2.2, -1.2, -1.2, -0.4, -0.5, 0.0, -0.5, 1.5, 1.4, 1.8, 2.1, 1.5, 1.9],
    # share of its thing that went, each for few and many returns
    [-0.2, -1.0, 0.8, -0.5, 0.5, 0.1, 0.0, -2.1],
    # share of the scan in the air, in fours by how much of that hangs in clouds
    [-1.7, 0.0, 0.0, 0.0, -0.4, -0.3, -0.6, 0.0, 0.2, 0.3, -0.4, -1.5, 0.0, -0.3, 0.5, -3.2, -0.2, 0.1,
     0.7, 0.3, 0.4, 0.5, 0.6, 1.6, 0.9, 0.0, -0.2, 0.5],
    # strength over that of bright things that stand; not known; in fives by range
    [0.5, 1.3, 0.8, 0.3, 0.0, -0.1, 1.0, 1.1, -0.8, -0.5, -1.2, 0.4, 0.5, 0.0, -0.1, -1.0, 0.3, 0.6, 0.4,
     -0.5, -0.9, 0.3, 0.8, 0.6, -0.2, -0.2, 0.1, 1.1, 0.8, -0.1, -0.6, 0.5, 0.8, 1.1, -0.3, -0.4, 0.1, 0.7,
     1.3, 0.5, 1.0, 0.3, 0.5, 1.1, -0.1, 0.8, 0.3, 0.4, 0.6, -0.5, 0.7, -0.5, -0.2, 0.0, -0.2, 0.9, -1.2,
     -1.3, -0.8, -0.4, 0.6, -1.3, -1.9, -2.6, -0.5, 0.0, -1.5, -2.6, -2.3, -0.5, -0.3, -0.2, 0.1, 0.5, 0.0],
    # how much is seen beyond, in fives by range
    [-1.6, -0.9, 0.1, -0.5, -2.3, 0.0, -0.1, 0.0, -0.4, -1.7, -1.0, -0.5, -0.1, -0.4, -0.4, 0.4, 0.1, 0.4,
     0.4, 0.7, 2.0, 1.0, 1.0, 1.1, 0.1],
    # voxels around that stand, in fives by class
    [1.0, 0.3, 1.6, 0.8, 0.6, -0.2, 0.2, -0.5, -0.6, 0.7, -0.5, -0.4, -0.9, -0.3, 0.6, -0.8, -0.2, -0.9,
     -0.2, 0.0, 0.0, -0.6, -0.2, -0.1, -1.7],
    # voxels around that went, in fours by how much hangs in clouds
    [0.2, -0.4, -0.5, -1.0, -0.4, 0.1, 0.4, -0.2, -0.5, -0.2, 0.0, -0.4, -0.2, 0.1, 0.0, -0.5, 0.1, 0.9,
     0.5, -0.3],
    # share of what lies around that went, by whether much is in the air there, and whether a moving box is near
    [-1.8, -0.5, -0.3, -0.5, -0.4, -0.4, 0.9, -0.2, 0.0, -0.6, 1.2, -0.4, 0.1, -1.6, 1.7, -0.5, 1.6, -1.0,
     1.0, -0.8],
    # height over the ground around; none; each by whether it is ground
    [-1.8, -0.2, -3.6, -3.2, 0.5, 0.7, 1.4, 2.4, 0.7, 1.2, 0.5, 0.1, 0.3, 0.0, -0.6, -0.9],
    # size of its thing, in fours by how much hangs in clouds, each by whether half of it is in the air
    [-0.3, 1.0, 0.3, 0.5, 0.6, 0.0, 0.4, -0.4, -0.7, 0.3, -0.2, -0.2, -0.2, 0.1, -0.3, -0.1, -0.5, -2.3,
     0.0, 0.1, -0.6, 0.7, -0.7, 0.6, 0.9, -0.3, 0.0, -0.5, -1.1, 0.3, -1.3, 1.0, 1.1, 0.0, 0.4, -0.1, -0.2,
     0.9, -1.7, 0.1],
    # share of the scan in the air, each by whether it hangs in clouds, in fives by class
    [-1.1, 0.0, -0.2, -0.4, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.4, 1.6, -1.1, -1.1, -0.6, -0.3, 0.1, -0.3,
     -0.1, 0.0, 0.2, 1.0, -0.8, -0.4, 0.4, -0.4, -0.2, -1.3, 0.1, -0.2, 0.2, -0.2, 0.1, -0.5, 0.1, -1.2,
     -0.7, -0.8, 0.1, -0.2, 0.0, -0.4, 0.2, -0.1, 0.2, 0.5, -0.5, 0.2, 0.5, 0.3, 0.3, -0.2, 0.9, 0.2, -0.2,
     0.3, 0.4, 0.8, 0.4, 0.2, 0.2, 0.0, 0.6, 0.6, -0.5, 0.1, -1.5, 0.8, 0.1, 0.7],
    # strength, in fives by class
    [0.5, -0.1, 1.0, 0.1, 1.4, -0.1, -0.6, 0.9, -0.5, 1.1, 0.4, -0.6, 0.7, 0.0, -0.9, 0.9, 0.3, 0.1, -0.3,
     -1.3, 1.0, 0.4, 0.1, 0.1, -1.0, 1.2, 0.7, 0.4, -0.4, -0.2, 1.1, 0.1, 0.4, 0.0, -0.1, 0.5, -0.2, 0.3,
     0.8, 0.6, 0.4, 1.1, 0.3, 0.6, 0.4, -0.1, 0.9, -0.3, 0.3, 0.6, -0.7, 0.3, -0.6, 0.2, 0.7, -1.4, 0.0,
     -1.2, -0.1, -0.2, -1.6, -1.4, -2.1, -0.2, -0.4, -2.6, -1.1, -1.4, -0.9, -0.9, -0.1, -0.3, 0.5, -0.3,
     0.3],
    # constant
    [-3.1],
])

SECOND = _table([
    # class by denoise (solid, dynamic, airborne, outlier, ground), each with its place unknown, standing, gone
    [0.2, -1.2, 0.7, -0.1, -0.9, 0.5, 0.9, -1.3, -0.4, 0.9, -0.5, -0.4, 0.2, 0.0, 0.0],
    # share of its thing in the air, in fives by the size of the thing
    [0.8, 0.1, -0.4, -1.8, -0.9, 0.0, 0.0, 0.6, 0.7, -2.5, 0.0, -0.6, -0.2, -0.3, -1.1, 0.0, 0.1, -0.3,
     1.1, 0.5, 0.0, -0.1, -1.0, -0.8, -1.2, 0.0, 0.0, -0.5, 0.1, 0.6, 1.0, 0.3, 0.8, 1.1, 2.3],
    # share of what lies around that is solid, in fours by how much that is
    [0.8, -1.4, -0.3, 0.8, 0.0, 0.0, -0.2, 1.0, 0.0, -1.2, -0.4, 0.9, 0.0, -1.3, -0.8, 0.6, 0.0, -0.4, 0.0,
     0.2],
    # share of what lies around that is in the air, in fives by class
    [-1.8, -1.8, -0.8, -1.0, 0.4, 0.6, -0.1, 0.4, 0.1, -1.0, -0.2, -0.5, -0.8, 0.0, -0.6, 0.2, 0.2, -0.3,
     0.2, 0.5, 0.9, 1.6, 0.6, 0.7, 0.9],
    # range, each by its thing: not, partly, mostly in the air
    [0.5, -0.6, 1.5, 0.3, -1.8, 1.4, -0.1, -0.1, 0.7, -0.9, 0.6, -0.3, -2.0, 0.0, -0.4],
    # share of the moving box around it in the air; in no box; beside one; each by whether denoise has it airborne
    [-1.3, -1.5, -1.0, -0.3, -1.4, -3.0, 0.9, 0.2, 0.1, -0.5, 0.9, 1.7, 0.5, 0.7, 0.8, 1.9],
    # share of its thing that went, each for few and many returns
    [-0.1, -0.9, 0.6, -1.1, 0.7, -0.4, 0.5, -0.8],
    # share of the scan in the air, in fours by how much of that hangs in clouds
    [-3.1, -0.3, -0.2, -1.5, -0.2, 0.7, -0.9, -2.1, -0.4, -0.2, 0.2, -0.2, -0.1, 0.1, 0.4, 0.8, 0.2, 0.4,
     0.7, 0.9, 0.2, 0.5, 0.3, 1.0, 0.8, 0.0, -0.1, 0.6],
    # strength over that of bright things that stand; not known; in fives by range
    [0.9, 0.9, 0.8, 0.0, 0.2, 0.0, 1.1, 1.0, -0.7, -0.3, -0.4, 0.3, 0.3, -0.2, -0.3, -0.7, 0.4, 0.5, 0.2,
     -0.5, -0.7, 0.2, 0.5, 0.4, 0.1, 0.0, 0.1, 0.8, 0.5, 0.2, -0.5, 0.2, 0.3, 0.7, 0.3, -0.3, 0.1, 0.3,
     1.1, 0.4, 1.0, 0.0, 0.1, 1.0, -0.1, 0.8, 0.2, 0.1, 0.5, -0.3, 0.7, -0.3, -0.3, 0.1, -0.3, 0.6, -0.8,
     -1.0, -0.6, -0.5, 0.5, -1.1, -1.5, -1.9, -0.6, -0.3, -1.4, -1.8, -2.0, -0.5, -0.2, 0.0, 0.2, 0.4,
     -0.2],
    # how much is seen beyond, in fives by range
    [-1.2, -0.7, -0.1, -0.5, -1.7, 0.1, -0.1, -0.2, -0.6, -1.4, -0.5, -0.3, -0.3, -0.4, -0.2, 0.7, 0.2,
     0.3, 0.2, 0.7, 2.2, 0.9, 0.8, 0.7, 0.1],
    # voxels around that stand, in fives by class
    [0.9, 0.0, 1.2, 1.0, 0.7, -0.2, 0.2, -0.5, -0.6, 0.6, -0.4, -0.5, -0.7, 0.0, 0.6, -0.7, 0.0, -0.6,
     -0.3, -0.1, 0.0, -0.3, -0.2, -0.1, -1.6],
    # voxels around that went, in fours by how much hangs in clouds
    [0.0, -0.3, -0.3, -0.6, -0.6, 0.4, 0.3, 0.1, -1.0, 0.1, 0.3, -0.1, -0.8, 0.5, 0.0, 0.0, -0.2, 0.6, 0.1,
     0.2],
    # share of what lies around that went, by whether much is in the air there, and whether a moving box is near
    [-0.5, -0.1, 1.4, 0.3, -0.6, 0.5, 1.1, -0.1, -0.3, -0.6, 0.4, -0.3, -0.7, -0.9, 0.8, 0.2, -0.7, -0.9,
     0.3, -0.5],
    # height over the ground around; none; each by whether it is ground
    [-1.7, -0.3, -3.7, -3.2, 0.8, 0.7, 1.3, 2.4, 0.7, 1.5, 0.4, 0.1, 0.7, 0.0, -0.1, -1.0],
    # size of its thing, in fours by how much hangs in clouds, each by whether half of it is in the air
    [0.2, 1.1, 0.1, 0.3, 0.4, 0.1, 0.1, -0.5, 0.0, 0.2, 0.0, 0.1, 0.0, 0.2, -0.3, -0.3, -0.4, -1.3, -0.2,
     -0.2, -0.1, 0.6, 0.3, 0.4, 0.2, -2.6, 0.2, 2.0, -0.3, 0.5, -0.5, 0.5, 0.0, 0.0, -1.1, 0.0, -1.6, 0.6,
     -1.3, 1.1],
    # share of the scan in the air, each by whether it hangs in clouds, in fives by class
    [-0.8, 0.0, -1.8, -0.6, -0.2, -1.0, -0.1, -0.3, -0.2, -0.1, 0.3, 0.0, -0.4, 0.2, 0.3, -1.0, -0.1, -1.4,
     -0.3, -0.2, 0.5, -1.1, 0.2, -0.3, 0.1, 0.2, 0.5, -0.8, 0.4, -0.3, -0.3, 0.1, 0.5, -0.3, 0.0, 0.0, 1.1,
     0.2, 0.3, -0.3, 0.3, -0.3, 0.0, 0.2, 0.3, 0.6, 0.0, 0.3, 0.2, 0.4, 0.5, -0.2, 0.9, -0.2, -0.3, 0.2,
     0.3, 0.5, 0.0, 0.3, 0.2, 0.0, 0.8, 0.4, -0.6, -0.1, -0.6, 0.6, 0.0, 0.5],
    # strength, in fives by class
    [0.1, -0.2, 0.9, 0.0, 2.0, 0.0, -0.7, 0.7, -0.3, 1.4, 0.5, -0.6, 0.6, -0.3, -0.5, 0.9, 0.5, 0.0, -0.1,
     -1.5, 0.9, 0.4, 0.2, -0.1, -1.0, 1.0, 0.6, 0.3, -0.1, -0.4, 1.0, -0.2, 0.5, -0.2, -0.1, 0.4, -0.1,
     0.3, 0.4, 0.4, 0.3, 0.6, 0.3, 0.5, 0.4, -0.2, 0.8, -0.3, 0.4, 0.5, -0.6, 0.2, -0.6, 0.2, 0.7, -1.1,
     0.1, -1.1, -0.2, 0.0, -1.4, -1.0, -1.6, -0.2, -0.5, -2.4, -0.8, -1.4, -0.4, -1.0, 0.2, -0.4, 0.4, 0.3,
     -0.3],
    # constant
    [-3.0],
])
# fmt: on
ROUNDS = (FIRST, SECOND)
