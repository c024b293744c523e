"""Parts of one thing that were taken for several: a lorry and its trailer, the two ends of a car."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects.filter import (
    HEIGHT,
    HITS,
    LENGTH,
    LENGTH_KNOWN,
    PROVEN,
    SMALL_M,
    SURE,
    VX,
    VY,
    WIDTH,
    WIDTH_KNOWN,
    YAW,
    P,
    X,
    Y,
)  # fmt: skip

GAP_M = 0.7
INSIDE_M, LIKE_SHARE = 0.3, 0.5
LEAST_HITS = 4.0
OFF_M_S, SURE_M_S = 1.2, 1.2
"""Parts of one thing drive at speeds that differ by less, and that are known so well."""
LEAST_M_S, SMALL_LEAST_M_S = 1.0, 3.0
"""What is slower is not joined: cars stand side by side, and people walk together."""


@kernel
def same(a: F8, b: F8, longest: float, widest: float) -> bool:
    """Whether two tracks are parts of one thing: side by side at one speed, and together no larger than things are."""
    if a[HITS] < LEAST_HITS or b[HITS] < LEAST_HITS:
        return False
    if max(a[P + 10] + a[P + 15], b[P + 10] + b[P + 15]) > SURE_M_S**2:
        return False
    if np.hypot(a[VX] - b[VX], a[VY] - b[VY]) > OFF_M_S:
        return False
    small = max(a[LENGTH], a[WIDTH], b[LENGTH], b[WIDTH]) <= SMALL_M
    if np.hypot(a[VX], a[VY]) < (SMALL_LEAST_M_S if small else LEAST_M_S):
        return False
    if np.hypot(a[X] - b[X], a[Y] - b[Y]) > 0.5 * (longest + max(b[LENGTH], b[WIDTH])):
        return False
    own, other = _reach(a, a), _reach(b, a)
    gap = max(max(own[0], other[0]) - min(own[1], other[1]), max(own[2], other[2]) - min(own[3], other[3]))
    along = max(own[1], other[1]) - min(own[0], other[0])
    across = max(own[3], other[3]) - min(own[2], other[2])
    return bool(gap < GAP_M and max(along, across) < longest and min(along, across) < widest)


@kernel
def _reach(row: F8, frame: F8) -> F8:
    """Lowest and highest u and v (4,) of a box around the middle of another, along the axes of that."""
    turn = row[YAW] - frame[YAW]
    c, s = abs(np.cos(turn)), abs(np.sin(turn))
    half_u = 0.5 * (c * row[LENGTH] + s * row[WIDTH])
    half_v = 0.5 * (s * row[LENGTH] + c * row[WIDTH])
    dx, dy = row[X] - frame[X], row[Y] - frame[Y]
    u = np.cos(frame[YAW]) * dx + np.sin(frame[YAW]) * dy
    v = np.cos(frame[YAW]) * dy - np.sin(frame[YAW]) * dx
    return np.array([u - half_u, u + half_u, v - half_v, v + half_v])


@kernel
def join(a: F8, b: F8) -> None:
    """Let the first track take in the box of the second."""
    own, other = _reach(a, a), _reach(b, a)
    sides = np.array([
        min(own[0], other[0]), max(own[1], other[1]), min(own[2], other[2]), max(own[3], other[3])
    ])  # fmt: skip
    u, v = 0.5 * (sides[0] + sides[1]), 0.5 * (sides[2] + sides[3])
    c, s = np.cos(a[YAW]), np.sin(a[YAW])
    a[X] += c * u - s * v
    a[Y] += s * u + c * v
    a[LENGTH], a[WIDTH] = sides[1] - sides[0], sides[3] - sides[2]
    a[LENGTH_KNOWN], a[WIDTH_KNOWN] = 1.0, 1.0
    a[HEIGHT] = max(a[HEIGHT], b[HEIGHT])
    a[PROVEN] = max(a[PROVEN], b[PROVEN])
    a[P] += 0.3
    a[P + 5] += 0.3


@kernel
def part_of(b: F8, a: F8, longest: float) -> bool:
    """Whether a track is a piece of a vehicle that is proven to drive: in its box, or next to the end of it that was not
    seen yet and about as wide."""
    if a[PROVEN] == 0.0 or b[PROVEN] > 0.0 or np.hypot(a[X] - b[X], a[Y] - b[Y]) > longest:
        return False
    r = _reach(b, a)
    half, side = 0.5 * a[LENGTH], 0.5 * a[WIDTH]
    small = max(b[LENGTH], b[WIDTH]) <= SMALL_M
    margin = 0.0 if small else INSIDE_M
    if r[2] < -side - margin or r[3] > side + margin:
        return False
    if r[0] >= -half - margin and r[1] <= half + margin:
        return True
    beyond = max(r[0] - half, -half - r[1])
    open_ended = a[LENGTH_KNOWN] < SURE and r[3] - r[2] >= LIKE_SHARE * a[WIDTH]
    return bool(open_ended and beyond < GAP_M and max(r[1], half) - min(r[0], -half) < longest)


@kernel
def merged(state: F8, longest: float, widest: float) -> NDArray[np.bool_]:
    """Join tracks that are parts of one thing into the older ones, in place, and drop pieces of proven vehicles; returns
    which remain (m,)."""
    remain = np.ones(len(state), np.bool_)
    for i in range(len(state)):
        if state[i, PROVEN] > 0.0:
            for k in range(len(state)):
                if k != i and remain[k] and part_of(state[k], state[i], longest):
                    remain[k] = False
    for i in range(len(state)):
        for k in range(i + 1, len(state)):
            if remain[i] and remain[k] and same(state[i], state[k], longest, widest):
                join(state[i], state[k])
                remain[k] = False
    return remain
