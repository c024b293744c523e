"""The map itself: how large it is and how crisp, without any truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import RemovedTile, Tile
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.evaluation.removed import crispness_figures
from scanloom.stages.geometry.entropy import mean_entropy, point_entropies


def map_figures(
    tiles: Parts[Tile],
    radii_m: tuple[float, ...],
    min_neighbours: int,
    samples: int,
    seed: int,
    removed: Parts[RemovedTile] | None = None,
) -> Iterator[Figure]:
    """Extent of the map and mean map entropy at a seeded sample of its points; tiles are read one by one."""
    counts = [len(tile) for tile in tiles]
    yield Figure("map.tiles", len(counts), "", "tiles of the map", "map")
    yield Figure("map.points", sum(counts), "", "points of all tiles", "map")
    if not sum(counts):
        return
    queries = _spread(counts, samples, seed)
    area_m2 = 0
    entropies = []
    for tile, chosen in zip(tiles, queries):
        points = np.column_stack((tile.x_m, tile.y_m, tile.z_m))
        area_m2 += _filled_squares(points)
        entropies.append(point_entropies(points, chosen, radii_m, min_neighbours))
    yield Figure("map.area_m2", area_m2, "m2", "squares of 1 m that hold a point, seen from above", "map")
    mean, share = mean_entropy(np.concatenate(entropies))
    for radius, m, s in zip(radii_m, mean, share):
        how = (
            f"mean of 1/2 ln det(2 pi e Sigma) over {len(np.concatenate(entropies))} sampled points; Sigma of the "
            f"neighbours within {radius} m in the same tile, at least {min_neighbours}"
        )
        yield Figure(f"map.mme_r{radius}_nat", float(m), "nat", how, "map")
        yield Figure(
            f"map.mme_r{radius}_share",
            float(s),
            "",
            "share of the sampled points with enough neighbours",
            "map",
        )
    if removed is not None and any(map(len, removed)):
        yield from crispness_figures(tiles, removed, queries, radii_m[len(radii_m) // 2], min_neighbours)


def _spread(counts: list[int], samples: int, seed: int) -> list[NDArray[np.int64]]:
    """Row numbers per tile of a sample without repetition of all points."""
    total = sum(counts)
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(total, min(samples, total), replace=False, shuffle=False))
    starts = np.concatenate(([0], np.cumsum(counts)))
    cuts = np.searchsorted(chosen, starts)
    return [chosen[a:b] - start for a, b, start in zip(cuts[:-1], cuts[1:], starts)]


def _filled_squares(points: NDArray[np.float32]) -> int:
    if len(points) == 0:
        return 0
    x, y = np.floor(points[:, 0]).astype(np.int64), np.floor(points[:, 1]).astype(np.int64)
    x, y = x - x.min(), y - y.min()
    filled = np.zeros((x.max() + 1, y.max() + 1), bool)
    filled[x, y] = True
    return int(filled.sum())
