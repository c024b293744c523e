"""Motion from the scans themselves: how the LiDAR moved between two neighbouring scans, for logs without sensors.

Both scans are thinned, compensated with the motion guessed so far, and registered; the result is the next guess.
Two scans distorted alike fit each other well, so the first result is near the truth and the loop ends soon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import Scan
from scanloom.stages.geometry.compensation import compensate
from scanloom.stages.geometry.degeneracy import translation_information
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.registration import Registration, SurfelMap, align
from scanloom.stages.geometry.se3 import F8, se3_log
from scanloom.stages.geometry.voxels import downsample

DENSE_POINTS = 8000
FINE_VOXEL_M, COARSE_VOXEL_M = 1.0, 2.0
"""Scans with fewer points than `DENSE_POINTS` after thinning need wider surfaces: their beams are far apart."""
TARGET_SPACING_M = 0.3
SOURCE_SPACING_M = 1.0
TARGET_POINTS = 40_000
SOURCE_POINTS = 1000
COARSE_SCALE_M, COARSE_STEPS = 0.5, 10
FINE_SCALE_M, FINE_STEPS = 0.15, 2
MOST_PASSES = 4
SETTLED_M_S = 1.0  # a guess wrong by this leaves an error of about 2 % of it
SETTLED_RAD_S = 0.1
LEAST_INLIERS = 60
LEAST_INLIER_SHARE = 0.6  # of the points that have a partner; scans that do not belong together reach 0.4
LEAST_INFORMATION = (
    0.03  # D; streets have 0.05 and more, tunnels and fields 0.02 and less, and errors of 10 m/s
)
LONGEST_PAUSE_S = 0.5
FASTEST_M_S = 70.0
FASTEST_RAD_S = 12.0
FIRST_SPEEDS_M_S = (0.0, 8.0, 16.0, 24.0, 32.0)
"""Forward speeds tried when nothing is known yet; the best fit is kept."""


class Points(NamedTuple):
    """Points of a scan with their stamps, all (n,)."""

    stamp_ns: NDArray[np.int64]
    x_m: NDArray[np.float32]
    y_m: NDArray[np.float32]
    z_m: NDArray[np.float32]

    def take(self, rows: slice | NDArray[np.int64]) -> Points:
        """These points, each column without gaps: kernels are compiled for that."""
        stamp_ns = np.ascontiguousarray(self.stamp_ns[rows])
        x, y, z = self.x_m[rows], self.y_m[rows], self.z_m[rows]
        return Points(stamp_ns, np.ascontiguousarray(x), np.ascontiguousarray(y), np.ascontiguousarray(z))


@dataclass(frozen=True)
class ThinScan:
    """A few points of a scan with their stamps: `dense` ones to be a target, `sparse` ones to be a source."""

    reference_ns: int
    dense: Points
    sparse: Points

    @classmethod
    def of(cls, scan: Scan) -> ThinScan:
        stride = max(1, len(scan) // TARGET_POINTS) | 1  # odd, so that no beam of an even number is left out
        some = Points(scan.stamp_ns, scan.x_m, scan.y_m, scan.z_m).take(slice(None, None, stride))
        points = np.column_stack(some[1:])
        dense = downsample(points, TARGET_SPACING_M)
        sparse = dense[downsample(points[dense], SOURCE_SPACING_M)]
        fewer = sparse[:: max(1, -(-len(sparse) // SOURCE_POINTS))]
        return cls(scan.reference_ns, some.take(dense), some.take(fewer))

    def rough(self) -> ThinScan:
        """Fewer points yet where there are many: enough for a first guess."""
        if len(self.dense.x_m) <= DENSE_POINTS:
            return self
        return ThinScan(
            self.reference_ns, self.dense.take(slice(None, None, 2)), self.sparse.take(slice(None, None, 3))
        )


def twist_between(a: ThinScan, b: ThinScan, track: MotionTrack, guess: F8 | None) -> F8 | None:
    """Twist (6,) of the LiDAR from scan a to scan b, (rad/s, m/s) in its own frame, or None when they do not fit.

    guess : twist of the pair before, if any. Rotation and translation that `track` covers are used as they are.
    """
    pause_s = (b.reference_ns - a.reference_ns) * 1e-9
    if not 0 < pause_s < LONGEST_PAUSE_S or min(len(a.sparse.x_m), len(b.sparse.x_m)) < 100:
        return None
    twist = None if guess is None else _settled_twist(a, b, track, guess)
    if twist is None:
        twist = _settled_twist(a, b, track, _first_guess(a.rough(), b.rough(), track, guess))
    return twist


def _settled_twist(a: ThinScan, b: ThinScan, track: MotionTrack, guess: F8) -> F8 | None:
    """Registered until compensating with the result changes it no more; None when the scans do not fit then."""
    pause_s = (b.reference_ns - a.reference_ns) * 1e-9
    twist = guess
    for _ in range(MOST_PASSES):
        found = _register(a, b, track, twist, FINE_SCALE_M, FINE_STEPS)
        before, twist = twist, se3_log(found.T_target_source) / pause_s
        if not _plausible(twist):
            return None
        if _settled(twist - before):
            return twist if _fits(found, len(b.sparse.x_m)) else None
    return None


def _first_guess(a: ThinScan, b: ThinScan, track: MotionTrack, last: F8 | None) -> F8:
    """The best of several forward speeds and of the twist before, each refined by one coarse registration."""
    forward = track.T_base_lidar[0, :3]  # x of the base in the LiDAR frame
    pause_s = (b.reference_ns - a.reference_ns) * 1e-9
    starts = [np.concatenate((np.zeros(3), speed * forward)) for speed in FIRST_SPEEDS_M_S]
    best, best_twist = -1.0, np.zeros(6)
    for start in starts if last is None else [last, *starts]:
        found = _register(a, b, track, start, COARSE_SCALE_M, COARSE_STEPS)
        fit = found.inlier_ratio / (1e-3 + np.nan_to_num(found.rmse_m, nan=1.0))
        if fit > best:
            best, best_twist = fit, se3_log(found.T_target_source) / pause_s
    return best_twist


def _register(
    a: ThinScan, b: ThinScan, track: MotionTrack, twist: F8, scale_m: float, iterations: int
) -> Registration:
    voxel_m = FINE_VOXEL_M if len(a.dense.x_m) > DENSE_POINTS else COARSE_VOXEL_M
    target = SurfelMap(voxel_m)
    target.insert(_compensated(a.dense, a.reference_ns, track, twist))
    return align(
        target, _compensated(b.sparse, b.reference_ns, track, twist), track.relative(a.reference_ns, b.reference_ns, twist),
        max_distance_m=voxel_m, scale_m=scale_m, max_iterations=iterations, free=_unknown(a, b, track),
    )  # fmt: skip


def _unknown(a: ThinScan, b: ThinScan, track: MotionTrack) -> F8:
    """Directions of the tangent (6, k) that the sensors do not tell between two scans."""
    cover = track.covers(a.reference_ns, b.reference_ns)
    return np.eye(6)[:, 3:] if cover.rotation else np.eye(6)


def _compensated(points: Points, reference_ns: int, track: MotionTrack, twist: F8) -> F8:
    out = np.empty((len(points.x_m), 3))
    out.T[:] = compensate(*points, reference_ns, track, twist)
    return out


def _fits(found: Registration, tried: int) -> bool:
    """Whether the scans belong together and say so in every direction: on a bare field the rings on the ground always
    fit best when nothing moves."""
    inliers = found.inlier_ratio * tried
    enough = inliers >= LEAST_INLIERS and inliers >= LEAST_INLIER_SHARE * len(found.points)
    return enough and translation_information(found) >= LEAST_INFORMATION


def _settled(change: F8) -> bool:
    return bool(np.linalg.norm(change[:3]) < SETTLED_RAD_S and np.linalg.norm(change[3:]) < SETTLED_M_S)


def _plausible(twist: F8) -> bool:
    return bool(np.linalg.norm(twist[:3]) < FASTEST_RAD_S and np.linalg.norm(twist[3:]) < FASTEST_M_S)
