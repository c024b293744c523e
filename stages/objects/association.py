"""Whose points are whose: those in a track's box are its own, and so is the rest of their cluster."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects.filter import (
    HITS,
    LENGTH,
    LENGTH_KNOWN,
    PROVEN,
    SURE,
    WIDTH,
    WIDTH_KNOWN,
    YAW,
    P,
    X,
    Y,
)

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

GATE_M = 0.4
MOST_GATE_M = 0.8
SMALLER = 0.001
"""Inside several boxes the smallest wins; its area, m2, counts so little that outside the nearest does."""
CELL_M = 0.25
NOBODY, SEVERAL = -1, -2
OWN_SHARE = 0.4
"""A cluster with so much of it in the box of a track is wholly the track's."""
GROWS_M = 2.0
"""A cluster does not reach farther out of the box of its track, nor out of its gate once the size is known."""


@kernel
def in_tracks(band: F4, state: F8, origin: F8, far: float) -> I4:
    """Track (n,) in whose box, widened by a gate, each point lies; NOBODY in none. The nearest box wins."""
    side = 2 * int(np.ceil(far / CELL_M)) + 1
    raster = np.full((side, side), NOBODY, np.int32)
    nearest = np.full((side, side), np.inf, np.float32)
    for m in range(len(state)):
        _paint(raster, nearest, m, state[m], origin)
    out = np.empty(len(band), np.int32)
    for n in range(len(band)):
        a = min(max(int(np.floor(band[n, 0] / CELL_M)) + side // 2, 0), side - 1)
        b = min(max(int(np.floor(band[n, 1] / CELL_M)) + side // 2, 0), side - 1)
        out[n] = raster[a, b]
    return out


@kernel
def _paint(raster: I4, nearest: F4, m: int, row: F8, origin: F8) -> None:
    side = len(raster)
    spread = np.sqrt(max(row[P], row[P + 5]))
    gate = min(GATE_M + (0.5 * spread if row[HITS] >= 3.0 else 0.0), MOST_GATE_M)
    x, y = row[X] - origin[0], row[Y] - origin[1]
    c, s = np.cos(row[YAW]), np.sin(row[YAW])
    reach = int(np.ceil((0.5 * np.hypot(row[LENGTH], row[WIDTH]) + 1.5 * gate) / CELL_M))
    i, j = int(np.floor(x / CELL_M)) + side // 2, int(np.floor(y / CELL_M)) + side // 2
    for a in range(max(i - reach, 0), min(i + reach + 1, side)):
        for b in range(max(j - reach, 0), min(j + reach + 1, side)):
            dx, dy = (a - side // 2 + 0.5) * CELL_M - x, (b - side // 2 + 0.5) * CELL_M - y
            u, v = abs(c * dx + s * dy) - 0.5 * row[LENGTH], abs(c * dy - s * dx) - 0.5 * row[WIDTH]
            off = max(u, v)
            rank = max(off, 0.0) + SMALLER * row[LENGTH] * row[WIDTH]
            if off < gate and rank < nearest[a, b]:
                nearest[a, b] = rank
                raster[a, b] = m


@kernel
def spread_over_clusters(
    owner: I4, label: I4, count: int, band: F4, state: F8, origin: F8, longest: float
) -> tuple[I4, I4]:
    """Give the rest of a cluster to the one track that has much of it, and to a vehicle that may turn out longer what lies
    in line with it. Returns the owners (n,), and of every cluster (count,) its track, SEVERAL, or NOBODY."""
    first = np.full(count, NOBODY, np.int32)
    own, size = np.zeros(count, np.int32), np.zeros(count, np.int32)
    for n in range(len(owner)):
        c = label[n]
        size[c] += 1
        if owner[n] == NOBODY:
            continue
        own[c] += 1
        if first[c] == NOBODY:
            first[c] = owner[n]
        elif first[c] != owner[n]:
            first[c] = SEVERAL
    fits = np.ones(count, np.bool_)
    for n in range(len(owner)):
        if first[label[n]] >= 0 and owner[n] == NOBODY:
            fits[label[n]] &= _close(band[n], state[first[label[n]]], origin)
    out = owner.copy()
    for n in range(len(owner)):
        c = label[n]
        if owner[n] != NOBODY or first[c] < 0:
            continue
        whole = fits[c] and own[c] >= OWN_SHARE * size[c]
        if whole or in_line(band[n], state[first[c]], origin, longest):
            out[n] = first[c]
    return out, first


@kernel
def in_line(point: F4, row: F8, origin: F8, longest: float) -> bool:
    """Whether a point may be of a vehicle, proven to drive, of which both ends were not seen yet: as far out as the longest
    vehicle would reach, and no farther to the side than it is wide."""
    if row[PROVEN] == 0.0 or row[LENGTH_KNOWN] >= SURE:
        return False
    dx, dy = point[0] + origin[0] - row[X], point[1] + origin[1] - row[Y]
    c, s = np.cos(row[YAW]), np.sin(row[YAW])
    u, v = abs(c * dx + s * dy), abs(c * dy - s * dx)
    return bool(u < longest - 0.5 * row[LENGTH] and v < 0.5 * row[WIDTH] + GATE_M)


@kernel
def _close(point: F4, row: F8, origin: F8) -> bool:
    dx, dy = point[0] + origin[0] - row[X], point[1] + origin[1] - row[Y]
    c, s = np.cos(row[YAW]), np.sin(row[YAW])
    u, v = abs(c * dx + s * dy) - 0.5 * row[LENGTH], abs(c * dy - s * dx) - 0.5 * row[WIDTH]
    known = max(row[LENGTH_KNOWN], row[WIDTH_KNOWN]) >= SURE
    return bool(max(u, v) < (GATE_M if known else GROWS_M))
