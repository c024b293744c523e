"""What was left out of the map: how many points of each class."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT
from scanloom.stages.evaluation.figures import Figure

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
