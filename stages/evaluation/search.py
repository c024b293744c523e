"""How well descriptors alone tell places seen before, under a stated protocol (methods 2.6).

A keyframe is a positive when an earlier scan lies within 4 m of it in truth (also 3, 5 and 10 m). A candidate of the
search is right when its two scans are that near. Over all thresholds of the descriptor's distance: precision is the
share of right ones among the candidates below it, recall the share of positives with a right one near.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from scanloom.schemas.loops import Loops
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.evaluation.loops import Judgement, Mask, loop_ends
from scanloom.stages.evaluation.paths import TruePath
from scanloom.stages.evaluation.precision import Curve
from scanloom.stages.evaluation.revisits import FOUND_WITHIN_M, Revisits
from scanloom.stages.geometry.se3 import F8

RADII_M = (3, 4, 5, 10)


def precision_recall(distance: F8, right: Mask, first_found: F8) -> Curve:
    """Over all thresholds of the distance.

    distance, right : (m,) of the candidates. first_found : (p,) for each positive the smallest distance of a right
    candidate near it, inf without any; p > 0, m > 0.
    """
    thresholds = np.unique(distance)
    order = np.argsort(distance, kind="stable")
    taken = np.searchsorted(distance[order], thresholds, side="right")
    hits = np.cumsum(right[order])[taken - 1]
    recall = np.searchsorted(np.sort(first_found), thresholds, side="right") / len(first_found)
    return Curve(thresholds, hits / taken, recall)


def search_figures(
    loops: Loops, judgement: Judgement, paths: Mapping[str, TruePath], back: Revisits
) -> Iterator[Figure]:
    """F1 max, recall at precision 1 and extended precision for each radius, where truth covers what was searched."""
    rows = np.flatnonzero(judgement.known & np.isfinite(loops.descriptor_distance))
    for radius_m in RADII_M:
        positive = back.positive(radius_m)
        if not (len(rows) and positive.any()):
            continue
        right = judgement.known & (judgement.apart_m <= radius_m)
        chosen = right & np.isfinite(loops.descriptor_distance)
        first = back.first_found(loop_ends(loops, chosen, paths, loops.descriptor_distance))
        curve = precision_recall(loops.descriptor_distance[rows], right[rows], first[positive])
        how = (
            f"over thresholds of the descriptor's distance: {len(rows)} candidates of the search, right when within "
            f"{radius_m} m in truth, {int(positive.sum())} keyframes with an earlier place as near, found when a right "
            f"candidate is within {FOUND_WITHIN_M:g} m of path"
        )
        name = f"loops.search_r{radius_m}"
        yield Figure(f"{name}_f1_max", curve.f1_max(), "", f"largest F1 {how}", "map")
        yield Figure(
            f"{name}_recall_at_p1",
            curve.recall_at(1.0),
            "",
            f"recall at full precision {how}",
            "map",
        )
        yield Figure(
            f"{name}_extended_precision",
            curve.extended_precision(),
            "",
            f"mean of precision at the smallest recall and recall at full precision {how}",
            "map",
        )
