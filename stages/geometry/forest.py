"""Disjoint sets as a forest: `parent` (n,) leads from each member to the smallest of its set (Tarjan 1975, by halving)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import Int

I4 = NDArray[np.int32]


@kernel
def root(parent: I4, member: Int) -> Int:
    """Smallest member of the set; shortens the way to it, in place."""
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member


@kernel
def join(parent: I4, a: Int, b: Int) -> None:
    """Make one set of those of `a` and `b`."""
    a, b = root(parent, a), root(parent, b)
    parent[max(a, b)] = min(a, b)
