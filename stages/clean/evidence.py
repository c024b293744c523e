"""What all chunks of a session, or all sessions, say of the voxels of one tile."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import BRICK_VOXELS, Rays
from scanloom.stages.clean.field import I8, brick_table, row_of
from scanloom.stages.geometry.kernels import kernel

I4 = NDArray[np.int32]
U2 = NDArray[np.uint16]
MOST = 65535


@dataclass(frozen=True)
class Evidence:
    """Bins per voxel (bricks, 512), with a hash table from brick to row. Names as in `schemas.clean.Rays`."""

    bricks: I8
    keys: I8
    rows: I4
    hits: U2
    tracked: U2
    before: U2
    between: U2
    after: U2

    @classmethod
    def of(cls, bricks: I8) -> Evidence:
        """Nothing yet on these bricks."""
        counts = np.zeros((5, len(bricks), BRICK_VOXELS), np.uint16)
        return cls(bricks, *brick_table(bricks, len(bricks)), *counts)

    def add(self, rays: Rays) -> None:
        """What the next chunk in time says."""
        _add(
            self.keys, self.rows, rays.brick, rays.hits, rays.tracked, rays.before, rays.between, rays.after,
            self.hits, self.tracked, self.before, self.between, self.after,
        )  # fmt: skip

    @property
    def through(self) -> U2:
        """Bins that saw through each voxel."""
        total = self.before.astype(np.uint32) + self.between + self.after
        capped: U2 = np.minimum(total, MOST).astype(np.uint16)
        return capped


def all_bricks(keys: Iterable[I8]) -> I8:
    """Each of the keys of several tables once, increasing."""
    return np.unique(np.concatenate([np.empty(0, np.int64), *keys]))


@kernel
def _add(
    keys: I8, rows: I4, brick: I8, more_hits: NDArray[np.uint8], more_tracked: NDArray[np.uint8],
    more_before: NDArray[np.uint8], more_between: NDArray[np.uint8], more_after: NDArray[np.uint8], hits: U2, tracked: U2,
    before: U2, between: U2, after: U2,
) -> None:  # fmt: skip
    """Append one chunk's sequence of hits and free bins to what came before it in time."""
    for n in range(len(brick)):
        row = row_of(keys, rows, brick[n])
        if row < 0:
            continue
        for q in range(hits.shape[1]):
            free = np.int64(more_before[n, q])
            if more_hits[n, q] == 0:
                if hits[row, q] > 0:
                    after[row, q] = min(MOST, after[row, q] + free)
                else:
                    before[row, q] = min(MOST, before[row, q] + free)
                continue
            if hits[row, q] > 0:
                gap = np.int64(between[row, q]) + after[row, q] + free + more_between[n, q]
                between[row, q] = min(MOST, gap)
            else:
                before[row, q] = min(MOST, before[row, q] + free)
                between[row, q] = more_between[n, q]
            after[row, q] = more_after[n, q]
            hits[row, q] = min(MOST, np.int64(hits[row, q]) + more_hits[n, q])
            tracked[row, q] = min(MOST, np.int64(tracked[row, q]) + more_tracked[n, q])
