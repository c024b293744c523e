"""Points that are gone, gathered into objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8


def objects_of(points: F8, link_m: float, min_points: int) -> NDArray[np.int32]:
    """Number (n,) of the object each of `points` (n, 3) belongs to, largest first; -1 in those that are too small.

    An object is what can be walked through in steps of at most `link_m`.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(points):
        return np.empty(0, np.int32)
    pairs = cKDTree(points).query_pairs(link_m, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    _, label = connected_components(links, directed=False)
    sizes = np.bincount(label)
    first = np.unique(label, return_index=True)[1]
    ranked = np.lexsort((first, -sizes))
    number = np.full(len(sizes), -1, np.int32)
    large = ranked[sizes[ranked] >= min_points]
    number[large] = np.arange(len(large), dtype=np.int32)
    return np.asarray(number[label])
