"""Figures of what was left out of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import RemovedTile
from scanloom.stages.evaluation.removed import count_figures
from scanloom.stages.geometry.entropy import mean_entropy, point_entropies
from tests.stages.evaluation.tiles import MANNER, map_values
from tests.tiles import tile_of


def counts(**points: int) -> ClassCounts:
    row = np.zeros((1, len(PointClass)), np.int64)
    for name, number in points.items():
        row[0, PointClass[name.upper()]] = number
    return ClassCounts(scan_index=np.zeros(1, np.int64), points=row, before=row)


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
    kept, gone = tile_of(road), tile_of(trail, kind=RemovedTile)
    found = map_values(kept, removed=(gone,))
    assert found["clean.mme_without_removed_nat"] < found["clean.mme_with_removed_nat"] - 0.05
    same = map_values(kept, removed=(tile_of(trail[:0], kind=RemovedTile),))
    assert same["clean.mme_without_removed_nat"] == same["clean.mme_with_removed_nat"]
    assert same["clean.mme_without_removed_nat"] == pytest.approx(
        found["clean.mme_without_removed_nat"], abs=0.02
    )
    assert not [name for name in map_values(kept) if name.startswith("clean")]


def test_entropy_with_what_was_left_out_is_that_of_all_points_together() -> None:
    rng = np.random.default_rng(1)
    kept, gone = rng.uniform(0, 4, (3000, 3)), rng.uniform(0, 4, (2000, 3))
    manner = replace(MANNER, samples=3000)
    found = map_values(tile_of(kept), removed=(tile_of(gone, kind=RemovedTile),), manner=manner)
    together = np.concatenate((kept, gone)).astype(np.float32)
    want, _ = mean_entropy(point_entropies(together, np.arange(3000), (0.5,), 6))
    assert found["clean.mme_with_removed_nat"] == pytest.approx(float(want[0]), abs=2e-3)
