"""Motion that is proven for good: a vehicle that drove metres on a smooth way, at one size, and left free space behind.

What comes later, a halt, a box that grows as the vehicle passes, cannot make it a thing that always stood there. A parked
car of which more is seen fails: its box moves no farther than it grows, and the places it leaves are not empty.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects import filter as kalman

LEAST_THROUGH, LEAST_SHARE = 3, 0.08
"""So many places, and so large a share of the points, must be seen to be empty in a scan to say that it moves."""
STRETCH = 40
"""So many of the latest scans are looked at."""
LEAST_SCANS = 10
DENIED_SHARE = 0.1
WAY_M, GROWTH_SHARE, STRAIGHT_SHARE = 3.0, 0.3, 0.7
VEHICLE_M = 2.4
ENDS = 3
"""A place is the mean of so many scans."""


def says_moving(asked: NDArray[np.int64]) -> NDArray[np.bool_]:
    """In which updates (n,) free space says that the track moves; `asked` (n, 3) as in its history."""
    through, taken, points = asked.T
    enough = through >= np.maximum(LEAST_THROUGH, LEAST_SHARE * points)
    return np.asarray(enough & (through > 2 * taken))


def denies_moving(asked: NDArray[np.int64]) -> NDArray[np.bool_]:
    """In which updates (n,) free space says that the track stands; `asked` (n, 3) as in its history."""
    through, taken, points = asked.T
    enough = taken >= np.maximum(LEAST_THROUGH, LEAST_SHARE * points)
    return np.asarray(enough & (taken >= through))


def proven(rows: F8, asked: NDArray[np.int64]) -> bool:
    """Whether the latest updates (n, kalman.STATE or more) prove that a vehicle drove; `asked` (n, 3) as in its history."""
    if len(rows) < LEAST_SCANS or max(rows[-1, kalman.LENGTH], rows[-1, kalman.WIDTH]) < VEHICLE_M:
        return False
    says, denies = int(says_moving(asked).sum()), int(denies_moving(asked).sum())
    if says < LEAST_SCANS or denies > DENIED_SHARE * says:
        return False
    place = rows[:, [kalman.X, kalman.Y]]
    places = np.stack([place[k : k + ENDS].mean(axis=0) for k in range(0, len(place) - ENDS + 1, ENDS)])
    way = float(np.hypot(*(places[-1] - places[0])))
    driven = float(np.hypot(*np.diff(places, axis=0).T).sum())
    sizes = np.sort(rows[:, [kalman.LENGTH, kalman.WIDTH]], axis=1)
    growth = float(np.ptp(sizes, axis=0).max())
    return way >= WAY_M and way >= STRAIGHT_SHARE * driven and growth <= GROWTH_SHARE * way
