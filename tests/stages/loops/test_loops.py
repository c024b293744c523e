"""Loops through box worlds: the true ones are found in both directions, the tempting false ones are not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels
from scanloom.stages.geometry.se3 import F8, inverse, se3_log
from scanloom.stages.loops.closing import Settings, loops
from scanloom.stages.loops.places import Settings as PlaceSettings
from tests.stages.loops.worlds import (
    START_NS,
    block,
    chunks,
    described,
    labels_of,
    odometry_of,
    one,
    polyline,
    scans_of,
)
from tests.worlds import GROUND_Z_M, BoxWorld

MINUTE_NS = 60_000_000_000


def passes(world: BoxWorld, legs: Sequence[F8]) -> tuple[list[DeskewedScan], F8]:
    """Scans of several straight passes a minute apart, as one session; what lies between them is not scanned."""
    scans: list[DeskewedScan] = []
    for k, T in enumerate(legs):
        scans += scans_of(world, T, seed=k, start_ns=START_NS + k * MINUTE_NS, first_index=len(scans))
    return scans, np.concatenate(legs)


def close(
    scans: list[DeskewedScan], T: F8, drift: F8 | None = None, ground_z: F8 | float = GROUND_Z_M
) -> Loops:
    """Loops of one session; `drift` (4, 4) displaces odometry after the first pass's last scan."""
    labels = labels_of(scans, T, ground_z)
    odometry = odometry_of(T, scans)
    if drift is not None:
        late = odometry.stamp_ns > START_NS + MINUTE_NS - 1
        odometry.T_odom_lidar[late] = drift @ odometry.T_odom_lidar[late]
    clouds, classes = chunks(Deskewed, scans), chunks(Labels, labels)
    seen = described(PlaceSettings(), clouds, classes, odometry)
    return loops(Settings(), clouds, classes, one(odometry), seen)


def errors(found: Loops, T: F8) -> tuple[F8, F8]:
    """Translation m and rotation deg of every candidate against truth."""
    truth = inverse(T[found.scan_i]) @ T[found.scan_j]
    xi = se3_log(inverse(truth) @ found.T_i_j)
    return np.linalg.norm(xi[:, 3:], axis=1), np.degrees(np.linalg.norm(xi[:, :3], axis=1))


def assert_all_true(found: Loops, T: F8) -> None:
    shift, turn = errors(found, T)
    assert np.all(shift[found.accepted] < 0.15)
    assert np.all(turn[found.accepted] < 0.5)


SIDE = -30.0
"""x of the western street of the block."""


def test_the_same_street_in_both_directions() -> None:
    there = polyline([(SIDE, 24), (SIDE, -24)])
    again = polyline([(SIDE + 0.5, 24), (SIDE + 0.5, -24)])
    back = polyline([(SIDE + 3, -24), (SIDE + 3, 24)])
    scans, T = passes(block(1), [there, again, back])
    found = close(scans, T)
    assert_all_true(found, T)
    opposite = found.T_i_j[:, 0, 0] < 0
    assert (found.accepted & ~opposite).sum() >= 2
    assert (found.accepted & opposite).sum() >= 2
    assert len(found) <= 40
    assert np.all(found.scan_i < found.scan_j)
    sigma = np.sqrt(np.diagonal(found.covariance[found.accepted], axis1=1, axis2=2))
    assert np.all(sigma[:, 3:] >= 0.05)
    assert np.all(sigma[:, 3:] < 0.3)


def test_found_by_looks_when_odometry_is_far_off() -> None:
    there = polyline([(SIDE, 24), (SIDE, -24)])
    again = polyline([(SIDE + 0.5, 24), (SIDE + 0.5, -24)])
    drift = np.eye(4)
    drift[:3, 3] = [2.5, 3.0, 0.4]
    scans, T = passes(block(1), [there, again])
    found = close(scans, T, drift)
    assert_all_true(found, T)
    assert found.accepted.sum() >= 2


def decks() -> BoxWorld:
    """A road between houses, with a second deck of the same width 6 m above it on pillars."""
    rng = np.random.default_rng(4)
    top = GROUND_Z_M + 6.0
    boxes = [[[-60, -6, top - 0.5], [60, 6, top]]]
    for side in (-1, 1):
        boxes += [[[-60, side * 6 - 0.15, top], [60, side * 6 + 0.15, top + 0.9]]]
        for x in np.arange(-55, 60, 12.0):
            boxes.append([[x, side * 5.5 - 0.4, GROUND_Z_M], [x + 0.8, side * 5.5 + 0.4, top]])
            y = sorted((side * 14.0, side * (14 + rng.uniform(4, 9))))
            boxes.append([[x, y[0], GROUND_Z_M], [x + rng.uniform(5, 10), y[1], rng.uniform(9, 14)]])
    return BoxWorld(np.array(boxes))


@pytest.mark.parametrize("odometry_height_error_m", [0.0, -5.5])
def test_two_decks_are_two_places(odometry_height_error_m: float) -> None:
    low = polyline([(-22, 0), (22, 0)])
    high = polyline([(-22, 0.5), (22, 0.5)], z=6.0)
    scans, T = passes(decks(), [low, high])
    drift = np.eye(4)
    drift[2, 3] = odometry_height_error_m
    ground = np.where(np.arange(len(T)) < len(low), GROUND_Z_M, GROUND_Z_M + 6.0)
    found = close(scans, T, drift, ground)
    assert len(found) > 0
    assert found.accepted.sum() == 0
    assert all(found.reason)


def test_a_tunnel_looks_the_same_everywhere() -> None:
    top = GROUND_Z_M + 5.0
    boxes = [[[-120, s * 5 - 0.5, GROUND_Z_M], [120, s * 5 + 0.5, top]] for s in (-1, 1)]
    world = BoxWorld(np.array([*boxes, [[-120, -5.5, top], [120, 5.5, top + 0.5]]], float))
    scans, T = passes(world, [polyline([(-20, 0), (20, 0)]), polyline([(-20, 0.4), (20, 0.4)])])
    drift = np.eye(4)
    drift[0, 3] = 4.0
    found = close(scans, T, drift)
    assert len(found) > 0
    assert found.accepted.sum() == 0


def test_a_street_that_repeats_itself_is_ambiguous() -> None:
    boxes = []
    for x in np.arange(-130, 130, 10.0):
        for side in (-1, 1):
            y = sorted((side * 9.0, side * 16.0))
            boxes.append([[x, y[0], GROUND_Z_M], [x + 6.0, y[1], 5.0]])
    scans, T = passes(
        BoxWorld(np.array(boxes)), [polyline([(-20, 0), (20, 0)]), polyline([(-20, 0.4), (20, 0.4)])]
    )
    drift = np.eye(4)
    drift[0, 3] = 5.5
    found = close(scans, T, drift)
    assert len(found) > 0
    assert found.accepted.sum() == 0


def test_other_sessions_are_searched_by_looks() -> None:
    world = block(1)
    T_a, T_b = polyline([(SIDE, 24), (SIDE, -24)]), polyline([(SIDE + 2.5, -20), (SIDE + 2.5, 20)])
    clouds, classes, tracks, seen = [], [], [], []
    for name, T, start in (("a", T_a, START_NS), ("b", T_b, START_NS - 30 * MINUTE_NS)):
        scans = scans_of(world, T, seed=len(clouds), start_ns=start)
        labels, odometry = labels_of(scans, T), odometry_of(T, scans)
        cloud, label = chunks(Deskewed, scans, session=name), chunks(Labels, labels, session=name)
        clouds.append(cloud)
        classes.append(label)
        tracks.append(one(odometry, name))
        seen.append(described(PlaceSettings(), cloud, label, odometry, name))
    joined = [
        Parts([pair for part in group for pair in part._parts]) for group in (clouds, classes, tracks, seen)
    ]
    found = loops(Settings(), *joined)
    assert set(found.session_i[found.accepted]) == {"b"}
    assert set(found.session_j[found.accepted]) == {"a"}
    truth = inverse(T_b[found.scan_i]) @ T_a[found.scan_j]
    xi = se3_log(inverse(truth) @ found.T_i_j)
    assert np.all(np.linalg.norm(xi[found.accepted, 3:], axis=1) < 0.15)
    assert found.accepted.sum() >= 2


def test_a_short_drive_has_no_candidates_and_mixed_inputs_are_an_error() -> None:
    T = polyline([(SIDE, 24), (SIDE, 14)])
    scans = scans_of(block(1), T)
    labels, odometry = labels_of(scans, T), odometry_of(T, scans)
    clouds, classes = chunks(Deskewed, scans), chunks(Labels, labels)
    seen = described(PlaceSettings(), clouds, classes, odometry)
    assert len(loops(Settings(), clouds, classes, one(odometry), seen)) == 0
    with pytest.raises(StageError, match="session a"):
        loops(Settings(), clouds, classes, one(odometry), one(seen[0], "b"))
    with pytest.raises(StageError, match="odometry"):
        loops(Settings(), clouds, classes, one(odometry.take(slice(0, 3))), seen)
