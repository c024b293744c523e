"""What counts as found, and what as lost, in the benchmark of particles."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from benchmarks.particles import scores, tally
from scanloom.schemas.scans import PointClass
from scanloom.stages.simulate.meshes import Material


def classes(**numbers: int) -> np.ndarray:
    return np.concatenate([np.full(n, PointClass[name], np.uint8) for name, n in numbers.items()])


def test_shares_are_of_points_in_range_that_are_not_the_own_vehicle() -> None:
    truth = classes(AIRBORNE=20, STATIC=70, DYNAMIC=10, EGO=5, OUTLIER=3)
    found = truth.copy()
    found[:2] = PointClass.STATIC
    found[2] = PointClass.OUTLIER
    found[20:23], found[23] = PointClass.AIRBORNE, PointClass.OUTLIER
    found[90] = PointClass.AIRBORNE
    found[100:105] = PointClass.AIRBORNE
    material = np.full(len(truth), Material.LEAF, np.uint8)
    material[20:50] = 0
    figures = {name: value for name, value, _ in scores(tally(found, truth, material))}
    assert figures["share"] == pytest.approx(20 / 103)
    assert figures["precision"] == pytest.approx(17 / 21)
    assert figures["recall"] == pytest.approx(17 / 20)
    assert figures["removed_recall"] == pytest.approx(18 / 20)
    assert figures["clean_loss"] == pytest.approx(5 / 80)
    assert figures["clean_loss_airborne"] == pytest.approx(4 / 80)
    assert figures["standing_loss"] == pytest.approx(4 / 70)
    assert figures["vegetation_loss"] == 0.0


def test_clear_air_has_no_precision_and_drives_add_up() -> None:
    truth = classes(STATIC=100)
    found = truth.copy()
    found[0] = PointClass.AIRBORNE
    one = tally(found, truth, np.full(100, Material.GRASS, np.uint8))
    other = tally(truth, truth, np.zeros(100, np.uint8))
    figures = {name: value for name, value, _ in scores(one + other)}
    assert "precision" not in figures
    assert figures["standing_loss"] == pytest.approx(1 / 200)
    assert figures["vegetation_loss"] == pytest.approx(1 / 100)
    assert Counter(all=200, named=1) <= one + other
