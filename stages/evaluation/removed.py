"""What was left out of the map: how many points of each class, and what that did to the map's crispness."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT, RemovedTile, Tile
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.geometry.entropy import mean_entropy, point_entropies

MEANING = {
    PointClass.DYNAMIC: "moved: seen through at other times, or tracked while they moved",
    PointClass.AIRBORNE: "in the air: dust, rain, snow",
    PointClass.OUTLIER: "alone: no surface gives so few returns",
    PointClass.CHANGED: "stood while this session passed, seen through by a later one",
}


def count_figures(counts: Iterable[ClassCounts]) -> Iterator[Figure]:
    """Points of one session by the classes that are left out, and what share they are of those that could be mapped."""
    total = np.zeros(len(PointClass), np.int64)
    for part in counts:
        total += part.points.sum(axis=0)
    usable = int(total.sum() - total[PointClass.EGO] - total[PointClass.OUT_OF_RANGE])
    if not usable:
        return
    for class_ in LEFT_OUT:
        name = class_.name.lower()
        yield Figure(f"clean.{name}_points", int(total[class_]), "", f"points that {MEANING[class_]}")
        yield Figure(
            f"clean.{name}_share",
            total[class_] / usable,
            "",
            f"of {usable} points but for own vehicle and range",
        )


def crispness_figures(
    tiles: Iterable[Tile], removed: Sequence[RemovedTile] | Iterable[RemovedTile], chosen: Iterable[np.ndarray],
    radius_m: float, least: int,
) -> Iterator[Figure]:  # fmt: skip
    """Mean map entropy at the same points of the map, with what was left out around them and without."""
    found: list[np.ndarray] = []
    for tile, out, rows in zip(tiles, removed, chosen, strict=True):
        kept, gone = (np.column_stack((t.x_m, t.y_m, t.z_m)) for t in (tile, out))
        without = point_entropies(kept, rows, (radius_m,), least)
        full = (
            point_entropies(np.concatenate((kept, gone)), rows, (radius_m,), least) if len(gone) else without
        )
        found.append(np.column_stack((full, without)))
    if not found:
        return
    both = np.concatenate(found)
    both = both[np.isfinite(both).all(axis=1)]
    mean, _ = mean_entropy(both)
    for name, value in zip(("with_removed", "without_removed"), mean):
        how = f"mean map entropy within {radius_m} m at {len(both)} points of the map that have it both ways"
        yield Figure(f"clean.mme_{name}_nat", float(value), "nat", how, "map")
