"""The sample's second session: enough parked cars have left where it drives, and others came."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.motion import build_motion
from scanloom.stages.simulate.settings import SECOND_DAY, Settings
from scanloom.stages.simulate.town import Town, build_town

DAY_S = 86_400
PASSED_M, MOVED_M = 8.0, 1.5


def cars(town: Town) -> F8:
    return np.array([thing.centre[:2] for thing in town.things if thing.what == "car"])


def test_cars_left_and_came_where_both_days_drive() -> None:
    days = (Settings(), Settings(**SECOND_DAY))
    assert days[1].town_seed == days[0].town_seed
    assert DAY_S <= days[1].start_s - days[0].start_s < 2 * DAY_S
    towns = [build_town(day.town_seed, day.parking_seed) for day in days]
    drives = []
    for day, town in zip(days, towns, strict=True):
        t = np.arange(0, day.duration_s, 0.2)
        drives.append(cKDTree(build_motion(day, town.path).poses(t)[:, :2, 3]))
    parked = [cars(town) for town in towns]
    passed = [(drives[0].query(p)[0] < PASSED_M) & (drives[1].query(p)[0] < PASSED_M) for p in parked]
    left = (cKDTree(parked[1]).query(parked[0])[0] > MOVED_M) & passed[0]
    came = (cKDTree(parked[0]).query(parked[1])[0] > MOVED_M) & passed[1]
    assert 8 <= left.sum() < passed[0].sum() - 8
    assert 8 <= came.sum() < passed[1].sum() - 8
    heading = np.diff(drives[1].data, axis=0)
    south = np.abs(drives[1].data[1:, 1]) < 3
    assert (heading[south, 0] > 0.5).sum() > 20
    assert (heading[south, 0] < -0.5).sum() > 20
    assert drives[1].data[:, 0].max() < 120
