"""What is known of each scan of a session's way: height, speed, errors, residuals, what was left out of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.evaluation import ErrorTrack
from scanloom.schemas.scans import PointClass
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.geometry.factor_rows import FixRows
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.report.plan import Quantity
from scanloom.stages.report.plots import I8
from scanloom.stages.report.ways import Way

_FIX_AWAY_M = 30.0
"""A scan farther along the way from the next fix has no residual."""
_SPEED_S = 0.6
"""Time over which a speed is taken, s."""


@dataclass(frozen=True)
class Known:
    """Products by session, as far as they exist."""

    poses: Mapping[str, Poses]
    odometry: Mapping[str, Odometry] = field(default_factory=dict)
    errors: Mapping[str, ErrorTrack] = field(default_factory=dict)
    fixes: Mapping[str, FixRows] = field(default_factory=dict)
    counts: Mapping[str, ClassCounts] = field(default_factory=dict)


def quantities(ways: Mapping[str, Way], known: Known) -> list[Quantity]:
    """All that some scan has a value of; the first is what a user looks for first."""
    found = [
        _each("error", "distance to truth", "m", ways, lambda name, way: _error(known.errors.get(name), way)),
        _each(
            "fix",
            "distance to the GNSS fix",
            "m",
            ways,
            lambda name, way: _residual(known.fixes.get(name), way),
        ),
        _each(
            "e1",
            "E1, error of the worst direction",
            "m",
            ways,
            lambda name, way: _e1(known.odometry.get(name), way),
        ),
        _each(
            "sigma",
            "standard deviation of the pose",
            "m",
            ways,
            lambda name, way: _sigma(known.poses.get(name), way),
        ),
        _each("speed", "speed", "m/s", ways, lambda name, way: speed_m_s(way)),
        _each("height", "height", "m", ways, lambda name, way: way.place_m[:, 2]),
        _each(
            "out", "left out of the scan", "%", ways, lambda name, way: _left_out(known.counts.get(name), way)
        ),
    ]
    return [quantity for quantity in found if any(np.isfinite(v).any() for v in quantity.values.values())]


def _each(
    key: str, label: str, unit: str, ways: Mapping[str, Way], values: Callable[[str, Way], F8]
) -> Quantity:
    found = {name: values(name, way) for name, way in ways.items()}
    return Quantity(key, label, unit, found, worse=key not in ("speed", "height"))


def speed_m_s(way: Way) -> F8:
    """Speed (n,) at each scan, over about half a second."""
    if len(way) < 2:
        return np.full(len(way), np.nan)
    stamp_s = (way.stamp_ns - way.stamp_ns[0]) * 1e-9
    before = np.interp(stamp_s - _SPEED_S / 2, stamp_s, way.driven_m)
    after = np.interp(stamp_s + _SPEED_S / 2, stamp_s, way.driven_m)
    length_s = np.minimum(stamp_s + _SPEED_S / 2, stamp_s[-1]) - np.maximum(stamp_s - _SPEED_S / 2, 0.0)
    return np.asarray((after - before) / np.maximum(length_s, 1e-3))


def _error(track: ErrorTrack | None, way: Way) -> F8:
    """Of the map; NaN where there is no truth."""
    values = np.full(len(way), np.nan)
    if track is not None and len(track):
        values[way.at_stamps(track.stamp_ns)] = track.fusion_error_m
    return values


def _e1(odometry: Odometry | None, way: Way) -> F8:
    values = np.full(len(way), np.nan)
    if odometry is not None and len(odometry):
        values[way.at_scans(odometry.scan_index)] = odometry.degeneracy_e
        values[way.at_scans(odometry.scan_index[:1])] = np.nan
    return values


def _sigma(poses: Poses | None, way: Way) -> F8:
    """Root of the summed variances of the position."""
    values = np.full(len(way), np.nan)
    if poses is not None and len(poses):
        variance = np.trace(poses.covariance[:, 3:, 3:], axis1=1, axis2=2)
        values[way.at_scans(poses.scan_index)] = np.sqrt(np.where(variance > 0, variance, np.nan))
    return values


def _residual(fixes: FixRows | None, way: Way) -> F8:
    """Of the fix that is nearest along the way; NaN where none is near."""
    values = np.full(len(way), np.nan)
    seen = np.flatnonzero(np.isfinite(fixes.horizontal_m)) if fixes is not None else np.empty(0, np.int64)
    if fixes is None or not len(seen) or not len(way):
        return values
    at_m = way.driven_m[way.at_scans(fixes.scan_index[seen])]
    order = np.argsort(at_m, kind="stable")
    at_m, residual = at_m[order], fixes.horizontal_m[seen][order]
    right = np.clip(np.searchsorted(at_m, way.driven_m), 0, len(at_m) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(at_m[left] - way.driven_m) <= np.abs(at_m[right] - way.driven_m), left, right)
    near = np.abs(at_m[nearest] - way.driven_m) <= _FIX_AWAY_M
    found: F8 = np.where(near, residual[nearest], np.nan)
    return found


def usable(points: I8) -> F8:
    """Points (n,) of scans that a map could take: all but those of the vehicle itself and out of range; counts (n, classes)."""
    apart = points[:, int(PointClass.EGO)] + points[:, int(PointClass.OUT_OF_RANGE)]
    return np.asarray(np.maximum(points.sum(axis=1) - apart, 1), float)


def share_percent(points: I8, class_: PointClass) -> F8:
    """Share (n,) of a class among the usable points of scans."""
    return np.asarray(100.0 * points[:, int(class_)] / usable(points))


def _left_out(counts: ClassCounts | None, way: Way) -> F8:
    values = np.full(len(way), np.nan)
    if counts is not None and len(counts):
        out = (PointClass.DYNAMIC, PointClass.AIRBORNE, PointClass.OUTLIER, PointClass.CHANGED)
        values[way.at_scans(counts.scan_index)] = sum(share_percent(counts.points, c) for c in out)
    return values
