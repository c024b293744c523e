"""Figures of what was left out of the map."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import RemovedTile, Tile
from scanloom.stages.evaluation.removed import count_figures, crispness_figures
from tests.tiles import tile_of


def counts(**points: int) -> ClassCounts:
    row = np.zeros((1, len(PointClass)), np.int64)
    for name, number in points.items():
        row[0, PointClass[name.upper()]] = number
    return ClassCounts(scan_index=np.zeros(1, np.int64), points=row, before=row)


def tile(kind: type[Tile], points: np.ndarray, class_: PointClass) -> Tile:
    return tile_of(points, kind=kind, class_=int(class_))


def test_shares_are_of_what_could_be_mapped() -> None:
    parts = [counts(static=60, dynamic=10, ego=500), counts(ground=20, airborne=10, out_of_range=300)]
    found = {f.name: f.value for f in count_figures(parts)}
    assert found["clean.dynamic_points"] == 10
    assert found["clean.dynamic_share"] == pytest.approx(0.1)
    assert found["clean.airborne_share"] == pytest.approx(0.1)
    assert found["clean.changed_points"] == 0
    assert "clean.ego_points" not in found


def test_nothing_counted_gives_no_figures() -> None:
    assert list(count_figures([])) == []
    assert list(count_figures([counts(ego=7)])) == []


def test_a_trail_through_a_street_blurs_it() -> None:
    rng = np.random.default_rng(0)
    road = np.column_stack((rng.uniform(0, 20, (4000, 2)), rng.normal(0, 0.01, 4000)))
    trail = np.column_stack((rng.uniform(0, 20, 1500), rng.uniform(8, 12, 1500), rng.uniform(0, 1.5, 1500)))
    kept, gone = tile(Tile, road, PointClass.GROUND), tile(RemovedTile, trail, PointClass.DYNAMIC)
    chosen = [np.arange(0, 4000, 10)]
    found = {f.name: f.value for f in crispness_figures([kept], [gone], chosen, 0.5, 6)}
    assert found["clean.mme_without_removed_nat"] < found["clean.mme_with_removed_nat"] - 0.05
    nothing = tile(RemovedTile, trail[:0], PointClass.DYNAMIC)
    same = {f.name: f.value for f in crispness_figures([kept], [nothing], chosen, 0.5, 6)}
    assert same["clean.mme_without_removed_nat"] == same["clean.mme_with_removed_nat"]
    assert same["clean.mme_without_removed_nat"] == pytest.approx(
        found["clean.mme_without_removed_nat"], abs=0.02
    )
