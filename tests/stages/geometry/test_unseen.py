"""Directions that no scan saw: which scans, which kind, how far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import so3_exp
from scanloom.stages.geometry.unseen import KINDS, SEEN_P, stretches, unseen, unseen_kinds
from tests.stages.mapping import odometry_of


def blinded(scans: int, weak: dict[int, tuple[int, float]]) -> Odometry:
    """Scans at rest, each seen but for one axis of the tangent (0 to 5) with the given probability."""
    odometry = odometry_of(np.tile(np.eye(4), (scans, 1, 1)))
    p = np.ones((scans, 6))
    for scan, (axis, probability) in weak.items():
        p[scan, axis] = probability
    return replace(odometry, direction_p=p)


def test_a_direction_is_unseen_below_the_limit_and_seen_at_it() -> None:
    odometry = blinded(4, {1: (3, SEEN_P), 2: (3, np.nextafter(SEEN_P, 0))})
    assert unseen(odometry).tolist() == [False, False, True, False]


def test_the_first_scan_of_a_segment_has_no_motion_to_be_seen() -> None:
    odometry = blinded(4, {0: (3, 0.0), 1: (3, 0.0), 2: (3, 0.0), 3: (3, 0.0)})
    odometry = replace(odometry, segment=np.array([0, 0, 1, 1], np.int32))
    assert unseen(odometry).tolist() == [False, True, False, True]


def test_kinds_are_told_in_the_vehicles_axes() -> None:
    odometry = blinded(5, {1: (3, 0.0), 2: (4, 0.0), 3: (5, 0.0), 4: (2, 0.0)})
    straight = unseen_kinds(odometry, np.eye(3))
    assert [KINDS[row.argmax()] for row in straight[1:]] == ["along", "across", "up", "turn"]
    assert straight.sum(axis=1).tolist() == [0, 1, 1, 1, 1]
    sideways = unseen_kinds(odometry, so3_exp([0, 0, np.pi / 2]))
    assert [KINDS[row.argmax()] for row in sideways[1:]] == ["across", "along", "up", "turn"]


def test_stretches_begin_at_the_scan_before() -> None:
    assert stretches(np.array([False, False, True, True, False, True])) == [(1, 3), (4, 5)]
    assert stretches(np.array([True, False])) == [(0, 0)]
    assert stretches(np.zeros(3, bool)) == []
    assert stretches(np.zeros(0, bool)) == []
