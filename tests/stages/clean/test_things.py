"""Returns and things by verdict, against the same in whole arrays; clusters against pairs of neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.clean import Standing
from scanloom.schemas.scans import PointClass
from scanloom.stages.clean.clusters import ABOVE, BESIDE, clusters
from scanloom.stages.clean.incidence import COLUMNS
from scanloom.stages.clean.things import judge_things, settle

JUDGED = (PointClass.UNLABELLED, PointClass.STATIC, PointClass.DYNAMIC)


def one_of_each() -> tuple[np.ndarray, ...]:
    """Every combination of class, standing, flying, in a box, close to one, above its foot."""
    every = np.meshgrid(range(9), range(4), *([0, 1],) * 4, indexing="ij")
    classes, said, fly, box, around, above = (each.ravel() for each in every)
    return (
        classes.astype(np.uint8),
        said.astype(np.uint8),
        fly > 0,
        (box - 1).astype(np.int32),
        around > 0,
        above > 0,
    )


def test_classes_of_returns_by_themselves() -> None:
    classes, said, fly, box, around, above = one_of_each()
    stands = said == Standing.STANDS
    expected = classes.copy()
    restored = np.isin(classes, (PointClass.DYNAMIC, PointClass.OUTLIER))
    expected[(classes == PointClass.AIRBORNE) | (stands & restored)] = PointClass.STATIC
    expected[(box >= 0) & (expected == PointClass.OUTLIER)] = PointClass.DYNAMIC
    expected[fly] = PointClass.AIRBORNE
    expected[(expected == PointClass.GROUND) & above] = PointClass.DYNAMIC
    judged = np.isin(expected, JUDGED)
    after = said.copy()
    after[(judged & ((box >= 0) | (around & ~stands))) | (expected == PointClass.DYNAMIC)] = Standing.MOVED
    out, found = settle(classes, said, fly, box, around, above)
    assert np.array_equal(out, expected)
    assert np.array_equal(found, judged)
    assert np.array_equal(said, after)


@pytest.mark.parametrize("least_share", [0.4, 0.6])
def test_things_go_with_what_is_told_of_most_of_them(least_share: float) -> None:
    rng = np.random.default_rng(3)
    count = 4000
    thing = np.sort(rng.integers(0, 900, count)).astype(np.int32)
    usable, judged = rng.random(count) < 0.8, rng.random(count) < 0.9
    usable &= judged
    first = np.flatnonzero(usable)
    thing[usable] = first[np.searchsorted(thing[first], thing[first])]
    thing[~usable] = np.flatnonzero(~usable)
    said = rng.choice(4, count, p=[0.2, 0.3, 0.3, 0.2]).astype(np.uint8)
    expected = np.full(count, PointClass.STATIC, np.uint8)
    for standing, class_ in (
        (Standing.CHANGED, PointClass.CHANGED),
        (Standing.MOVED, PointClass.DYNAMIC),
    ):
        told = judged & (said == standing)
        size = np.bincount(thing, minlength=count)
        whole = (size >= 5) & (np.bincount(thing, told, count) / np.maximum(size, 1) >= least_share)
        expected[told | (usable & whole[thing])] = class_
    out = np.full(count, PointClass.STATIC, np.uint8)
    judge_things(thing, judged, usable, said, 5, least_share, out)
    assert np.array_equal(out, expected)
    assert set(np.unique(out)) == {PointClass.STATIC, PointClass.DYNAMIC, PointClass.CHANGED}


def test_clusters_are_chains_of_neighbours_about_as_far_away() -> None:
    rng = np.random.default_rng(8)
    row, column = np.meshgrid(np.arange(60, 90), np.r_[0:40, COLUMNS - 40 : COLUMNS], indexing="ij")
    cell = (row * COLUMNS + column).ravel().astype(np.int32)
    order = rng.permutation(len(cell))
    cell = cell[order]
    away = rng.choice([10.0, 10.3, 11.0, 30.0], len(cell)).astype(np.float32)
    usable = rng.random(len(cell)) < 0.5
    found = clusters(away, usable, cell, 0.4)
    label = _chained(away, usable, cell)
    assert np.array_equal(found[usable], label[usable])
    assert np.array_equal(found[~usable], np.flatnonzero(~usable))
    assert 10 < len(np.unique(found[usable])) < usable.sum() / 2


def _chained(away: np.ndarray, usable: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Smallest number of each chain, by passing it on until nothing changes."""
    at = {int(c): n for n, c in enumerate(cell) if usable[n]}
    links = []
    for c, n in at.items():
        row, column = divmod(c, COLUMNS)
        beside = [at.get(row * COLUMNS + (column + step) % COLUMNS) for step in range(1, BESIDE + 1)]
        links += [(n, m) for m in beside if m is not None and abs(away[n] - away[m]) < 0.4]
        above = [at.get(c + step * COLUMNS) for step in range(1, ABOVE + 1)]
        next_ = next((m for m in above if m is not None), None)
        if next_ is not None and abs(away[n] - away[next_]) < 0.6:
            links.append((n, next_))
    label, changed = np.arange(len(cell)), True
    while changed:
        changed = False
        for n, m in links:
            if label[n] != label[m]:
                label[n] = label[m] = min(label[n], label[m])
                changed = True
    return label
