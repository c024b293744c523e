"""Degeneracy: is the tunnel's axis called weak where it is, only there, and does it help to know."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.comparison import OURS, Result, Runner
from benchmarks.scores import Score, interpolated, true_poses
from benchmarks.sequences import TUNNEL_M, Recording
from benchmarks.systems import Outcome
from scanloom.schemas.scans import Deskewed, Labels, PointClass
from scanloom.schemas.session import Session
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.se3 import F8, inverse, transform
from scanloom.stages.odometry import Settings
from scanloom.stages.simulate.terrain import Plan

TUNNEL = Plan(TUNNEL_M).tunnel
PORTAL_M = 10.0
"""Scans are in the tunnel when they are this far or farther from its ends, on a street when as far outside."""
OUTSIDE_SHARE, OUTSIDE_M = 0.005, 0.5
"""A scan is blind to the axis when less than this share of its static points, ground apart, lies so far or farther outside
the tunnel: some seven of the points that are registered. Behind the entrance the houses of the street are in sight."""
WITHIN_DEG = 15.0
MOVING_M = 0.02
"""Way between scans from which on there is a driving axis."""
HALF_WIDTH_M = 6.0
"""Of the strip along y = 0 in which the tunnel lies."""


@dataclass(frozen=True)
class Stretch:
    """Rows of an outcome by where the LiDAR truly is."""

    inside: NDArray[np.bool_]
    outside: NDArray[np.bool_]
    """On street; the open field behind the tunnel is none."""
    moving: NDArray[np.bool_]


def stretch(true: F8) -> Stretch:
    """Scans well inside the tunnel and scans well outside, by true positions (n, 4, 4) in the simulator's world."""
    x, y = true[:, 0, 3], true[:, 1, 3]
    lane = np.abs(y) < HALF_WIDTH_M
    inside = lane & (x > TUNNEL[0] + PORTAL_M) & (x < TUNNEL[1] - PORTAL_M)
    near = lane & (x > TUNNEL[0] - PORTAL_M) & (x < TUNNEL[1] + PORTAL_M)
    step = np.linalg.norm(np.gradient(true[:, :3, 3], axis=0), axis=1)
    return Stretch(inside, (x < TUNNEL[0]) & ~near, step > MOVING_M)


def axis_flagged(outcome: Outcome, forward: F8, least_p: float) -> NDArray[np.bool_]:
    """(n,) whether the least observed direction is a translation along `forward` (3,), LiDAR frame, with p below `least_p`."""
    p, directions = outcome.extra["direction_p"], outcome.extra["weak_directions"]
    weakest = np.argmin(p, axis=1)
    rows = np.arange(len(p))
    translation = directions[rows, 3:, weakest]
    length = np.linalg.norm(translation, axis=1)
    along = np.abs(translation @ forward) / np.maximum(length, 1e-12)
    mostly_translation = length > np.sqrt(0.5)
    flagged: NDArray[np.bool_] = (
        (p[rows, weakest] < least_p) & mostly_translation & (along > np.cos(np.radians(WITHIN_DEG)))
    )
    return flagged


def flags(truth: Truth, outcome: Outcome, forward: F8, least_p: float) -> tuple[NDArray[np.bool_], Stretch]:
    """Flags and places of the scans after the first; the first has no map to be judged by."""
    true, _ = true_poses(truth, outcome)
    flagged = axis_flagged(outcome, forward, least_p)
    where = stretch(true)
    return flagged[1:], Stretch(where.inside[1:], where.outside[1:], where.moving[1:])


def error_percent(truth: Truth, outcome: Outcome) -> float:
    """Error of the motion from the last scan before the tunnel to the first behind it, % of the way between."""
    true, estimate = true_poses(truth, outcome)
    x, lane = true[:, 0, 3], np.abs(true[:, 1, 3]) < HALF_WIDTH_M
    within = np.flatnonzero(lane & (x > TUNNEL[0]) & (x < TUNNEL[1]))
    first, last = max(within[0] - 1, 0), min(within[-1] + 1, len(true) - 1)
    wanted, found = inverse(true[first]) @ true[last], inverse(estimate[first]) @ estimate[last]
    off = (inverse(wanted) @ found)[:3, 3]
    return float(100 * np.linalg.norm(off) / np.linalg.norm(wanted[:3, 3]))


def scores(
    runner: Runner, recordings: Mapping[str, Recording], chosen: Mapping[tuple[str, str], Result]
) -> Iterator[Score]:
    """The tunnel's figures; the town's sequences count as street as well."""
    recording = recordings["tunnel"]
    truth = recording.one(Truth)
    least_p = float({**Settings().model_dump(), **runner.settings}["least_p"])
    handled = chosen["tunnel", OURS].outcome
    ignored = runner.outcome(OURS, recording, {"timed": False, "settings": {"least_p": 0.0}})
    flagged, where = flags(truth, handled, _forward(recording), least_p)
    blind = where.inside & (outside_shares(recording, truth)[1:] < OUTSIDE_SHARE)
    streets = [flagged[where.outside & where.moving]]
    for name, other in recordings.items():
        if name.startswith("town") and (name, OURS) in chosen:
            own = chosen[name, OURS].outcome
            on_street, place = flags(other.one(Truth), own, _forward(other), least_p)
            streets.append(on_street[place.moving])
    yield from _said(flagged[blind], flagged[where.inside], np.concatenate(streets), least_p)
    with_it, without = error_percent(truth, handled), error_percent(truth, ignored)
    yield Score("error_percent", with_it, "%", "error of the motion through the tunnel over its length")
    yield Score(
        "error_off_percent", without, "%", "the same with degeneracy handling off (odometry.least_p = 0)"
    )
    yield Score(
        "worse_without", without / with_it, "", "error with degeneracy handling off over error with it"
    )


def _said(
    blind: NDArray[np.bool_], inside: NDArray[np.bool_], street: NDArray[np.bool_], least_p: float
) -> Iterator[Score]:
    how = f"weakest direction within {WITHIN_DEG:g} deg of the driving axis and p < {least_p:g}"
    walls = f"that see walls and ceiling alone (under {100 * OUTSIDE_SHARE:g} % of static points outside)"
    near = f"share of {len(inside)} scans in the tunnel of {TUNNEL_M:g} m, {PORTAL_M:g} m or more from its portals"
    yield Score("axis_flagged_inside", float(inside.mean()), "", f"{near}: {how}")
    yield Score(
        "axis_flagged_walls_only",
        float(blind.mean()),
        "",
        f"share of the {len(blind)} of them {walls}: {how}",
    )
    yield Score(
        "axis_flagged_street", float(street.mean()), "", f"share of {len(street)} scans on streets: {how}"
    )


def outside_shares(recording: Recording, truth: Truth) -> F8:
    """(n,) share of the static points of each scan, ground apart, that truly lie outside the tunnel."""
    shares = []
    for flat, named in zip(recording.parts(Deskewed), recording.parts(Labels), strict=True):
        for scan, label in zip(flat, named, strict=True):
            T, _ = interpolated(truth, np.array([scan.reference_ns]))
            x = transform(T[0], scan.points()[label.class_ == PointClass.STATIC].astype(np.float64))[:, 0]
            outside = (x < TUNNEL[0] - OUTSIDE_M) | (x > TUNNEL[1] + OUTSIDE_M)
            shares.append(outside.mean() if len(x) else 1.0)
    return np.array(shares)


def _forward(recording: Recording) -> F8:
    """Driving direction (3,) in the LiDAR's frame."""
    forward: F8 = np.array(recording.one(Session).T_base("lidar"))[0, :3]
    return forward
