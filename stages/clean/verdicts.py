"""Verdicts on voxels: what a session met there stands, moved, or has changed since."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import BRICK_SIDE, Standing
from scanloom.stages.clean.evidence import I4, U2
from scanloom.stages.clean.field import I8, brick_key, inner, row_of
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int, unpack

U1 = NDArray[np.uint8]
STANDS, MOVED, CHANGED = int(Standing.STANDS), int(Standing.MOVED), int(Standing.CHANGED)


@kernel
def judge_own(
    bricks: I8, keys: I8, rows: I4, hits: U2, tracked: U2, through: U2, between: U2, after: U2, limits: F8
) -> U1:
    """MOVED, STANDS or UNKNOWN (bricks, 512) by a session's own bins.

    limits: share, away_bins, flicker, arrived_bins, stands_share, stands_bins, tracked_share.

    Seen through counts only where all six neighbours were seen through, too: a wall, a roof or a kerb has an inside that
    no ray ever passed. What was met there moved if it was seen through at least `share` times as often as it was met; or,
    for what stood long and then left, `away_bins` times outside of the time it was met, and next to never within (a tree
    flickers: there, free bins lie between hits). What came, was met in `arrived_bins` and never left again stands. It moved
    in any case if `tracked_share` of its hits are of what the tracker saw move.
    """
    out = np.zeros(hits.shape, np.uint8)
    for n in range(len(bricks)):
        for q in range(hits.shape[1]):
            h, v = np.int64(hits[n, q]), np.int64(through[n, q])
            if h == 0:
                continue
            outside = v - np.int64(between[n, q])
            often = v >= 1 and v >= limits[0] * h
            left = outside >= limits[1] and between[n, q] <= limits[2] * outside
            came = h >= limits[3] and after[n, q] == 0 and between[n, q] <= limits[2] * outside
            if tracked[n, q] > 0 and tracked[n, q] >= limits[6] * h:
                out[n, q] = MOVED
            elif came:
                out[n, q] = STANDS
            elif (often or left) and open_around(bricks[n], q, n, keys, rows, through):
                out[n, q] = MOVED
            elif h >= limits[5] and v <= limits[4] * h:
                out[n, q] = STANDS
    return out


@kernel
def judge_later(
    bricks: I8, keys: I8, rows: I4, verdict: U1, hits: U2, later_hits: U2, later_through: U2, away_bins: int, share: float
) -> None:  # fmt: skip
    """Turn into CHANGED, in place, what stood for this session and later ones saw through, hardly ever meeting anything."""
    for n in range(len(bricks)):
        for q in range(hits.shape[1]):
            if hits[n, q] == 0 or verdict[n, q] == MOVED:
                continue
            v, h = np.int64(later_through[n, q]), np.int64(later_hits[n, q])
            if v >= away_bins and h <= share * v and open_around(bricks[n], q, n, keys, rows, later_through):
                verdict[n, q] = CHANGED


@kernel
def open_around(brick: Int, q: Int, row: Int, keys: I8, rows: I4, through: U2) -> bool:
    """Whether the six voxels beside a voxel were seen through, too."""
    u, v, w = q >> 6, (q >> 3) & 7, q & 7
    if 0 < u < 7 and 0 < v < 7 and 0 < w < 7:
        return bool(
            through[row, q - 1] > 0 and through[row, q + 1] > 0
            and through[row, q - 8] > 0 and through[row, q + 8] > 0
            and through[row, q - 64] > 0 and through[row, q + 64] > 0
        )  # fmt: skip
    a, b, c = unpack(brick)
    i, j, k = a * BRICK_SIDE + u, b * BRICK_SIDE + v, c * BRICK_SIDE + w
    for axis in range(3):
        for side in (-1, 1):
            x, y, z = i, j, k
            if axis == 0:
                x = i + side
            elif axis == 1:
                y = j + side
            else:
                z = k + side
            at = row_of(keys, rows, brick_key(x, y, z))
            if at < 0 or through[at, inner(x, y, z)] == 0:
                return False
    return True
