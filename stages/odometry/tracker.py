"""One scan after the other onto the local map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.geometry.degeneracy import Degeneracy, blind, judge, scan_covariance
from scanloom.stages.geometry.registration import Registration, VoxelMap, align
from scanloom.stages.geometry.se3 import F8, inverse, se3_log, transform
from scanloom.stages.odometry.prediction import Prediction, Predictor, forward_guesses
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.thinning import ThinScan

MIN_POINTS = 50
MIN_INLIERS = 30
MIN_INLIERS_OF_MATCHES = 0.4
FADING = 0.9
MAX_BRIDGED = 10
DROP_SHARE = 0.1
"""Of the local map's radius: after this way what is too far is dropped. Each time the whole map is copied."""


@dataclass(frozen=True)
class Row:
    """What odometry says of one scan; the columns of the product."""

    scan_index: int
    stamp_ns: int
    T_odom_lidar: F8
    covariance: F8
    inlier_ratio: float
    rmse_m: float
    seen: Degeneracy
    keyframe: bool
    reliable: bool


class Tracker:
    """State between scans: pose, local map, last keyframe, and how well predictions have been."""

    def __init__(self, settings: Settings, predictor: Predictor, T_base_lidar: F8) -> None:
        self.settings = settings
        self.predictor = predictor
        self.guesses = forward_guesses(T_base_lidar)
        self.map = self._new_map()
        self.T = np.eye(4)
        self.last_ns = 0
        self.scans = 0
        self.bridged = 0
        self.deviation = RunningDeviation(settings.first_deviation_m)
        self.inlier_ratio = 0.0
        self.keyframe_T, self.keyframe_ns = np.eye(4), 0
        self.inserted_T = np.eye(4)
        self.dropped_m = np.zeros(3)

    def step(self, scan: ThinScan) -> Row:
        """Take the next scan."""
        index, stamp_ns = scan.scan_index, scan.stamp_ns
        first = self.scans == 0
        self.scans += 1
        if first:
            return self._begin(index, stamp_ns, scan.fine)
        prediction = self.predictor.predict(self.last_ns, stamp_ns)
        found = self._register(scan.coarse, prediction)
        motion = found.T_last_now if found.reliable else prediction.T_last_now
        self._move(stamp_ns, motion, prediction, found)
        self._extend_map(scan.fine, found.reliable)
        keyframe = self._is_keyframe(stamp_ns)
        return Row(
            index,
            stamp_ns,
            self.T,
            found.covariance,
            found.inlier_ratio,
            found.rmse_m,
            found.seen,
            keyframe,
            found.reliable,
        )

    def _begin(self, index: int, stamp_ns: int, fine: F8) -> Row:
        self.map.insert(fine)
        self.last_ns = self.keyframe_ns = stamp_ns
        enough = len(fine) >= MIN_POINTS
        floor = np.diag([self.settings.floor_rad**2] * 3 + [self.settings.floor_m**2] * 3)
        return Row(index, stamp_ns, self.T, floor, 1.0 if enough else 0.0, 0.0, blind(), True, enough)

    def _register(self, coarse: F8, prediction: Prediction) -> Found:
        """Align to the map from the prediction; directions the scan does not tell stay as predicted."""
        if len(coarse) < MIN_POINTS or len(self.map) < MIN_POINTS:
            return Found.nothing(prediction)
        registration = self._align_from(prediction, coarse)
        snr = self.settings.measured_snr if prediction.measured else self.settings.snr
        seen = judge(registration, point_noise_m=self.settings.point_noise_m, snr=snr)
        weak = seen.p < self.settings.least_p
        if weak.any():
            registration = self._align(
                coarse, self.T @ prediction.T_last_now, free=seen.observed(self.settings.least_p)
            )
        T_last_now = inverse(self.T) @ registration.T_target_source
        covariance = scan_covariance(
            seen, registration.sigma2, inflation=self.settings.covariance_inflation, floor_m=self.settings.floor_m,
            floor_rad=self.settings.floor_rad, predicted=prediction.covariance, least_p=self.settings.least_p,
        )  # fmt: skip
        reliable = self._credible(registration, len(coarse), prediction)
        if not reliable:
            covariance = prediction.covariance
        return Found(
            T_last_now,
            covariance,
            registration.inlier_ratio,
            registration.rmse_m,
            seen,
            reliable,
            not weak.any(),
        )

    def _align_from(self, prediction: Prediction, coarse: F8) -> Registration:
        """From the prediction; where that fails (slip, nothing known yet) the best from other starts."""
        first = self._align(coarse, self.T @ prediction.T_last_now)
        if prediction.known and self._credible(first, len(coarse), prediction):
            return first
        others = (prediction.steady,) if prediction.known else self.guesses
        tries = [first, *(self._align(coarse, self.T @ start) for start in others)]
        return max(tries, key=lambda r: (self._credible(r, len(coarse), prediction), r.inlier_ratio))

    def _align(self, coarse: F8, T: F8, free: F8 | None = None) -> Registration:
        scale = float(np.clip(self.deviation.rms_m, self.settings.least_scale_m, self.settings.most_scale_m))
        return align(
            self.map, coarse, T, max_distance_m=self.settings.voxel_size_m, scale_m=scale,
            max_iterations=self.settings.max_iterations, free=free,
        )  # fmt: skip

    def _credible(self, registration: Registration, points: int, prediction: Prediction) -> bool:
        """Converged, on enough of the scan, and not further from the prediction than motion can explain."""
        inliers = registration.inlier_ratio * points
        if not registration.converged or registration.inlier_ratio < self.settings.least_inlier_ratio:
            return False
        if inliers < max(MIN_INLIERS, MIN_INLIERS_OF_MATCHES * len(registration.points)):
            return False
        if not prediction.known:
            return True
        if registration.inlier_ratio < 0.5 * self.inlier_ratio:
            return False
        correction = se3_log(inverse(self.T @ prediction.T_last_now) @ registration.T_target_source)
        bound_m = max(self.settings.least_bound_m, 5.0 * self.deviation.rms_m)
        too_far = np.linalg.norm(correction[3:]) > bound_m
        return not too_far and bool(np.linalg.norm(correction[:3]) < self.settings.bound_rad)

    def _move(self, stamp_ns: int, motion: F8, prediction: Prediction, found: Found) -> None:
        if found.reliable:
            self.predictor.learn(self.last_ns, stamp_ns, motion, well_seen=found.well_seen)
            if prediction.known:
                self.deviation.add(inverse(prediction.T_last_now) @ motion, found.seen.range_m)
            self.inlier_ratio += (
                0.1 * (found.inlier_ratio - self.inlier_ratio) if self.inlier_ratio else found.inlier_ratio
            )
        self.T = orthonormal(self.T @ motion)
        self.last_ns = stamp_ns
        if not found.reliable:
            self.inlier_ratio *= FADING
        self.bridged = 0 if found.reliable else self.bridged + 1

    def _extend_map(self, fine: F8, reliable: bool) -> None:
        """Add the scan when it was registered and the vehicle moved; start anew when the map was lost for long."""
        if self.bridged >= MAX_BRIDGED or len(self.map) < MIN_POINTS:
            self.map, self.bridged, self.inlier_ratio = self._new_map(), 0, 0.0
        elif not reliable or not moved(
            self.inserted_T, self.T, self.settings.insert_m, self.settings.insert_rad
        ):
            return
        self.map.insert(transform(self.T, fine))
        self.inserted_T = self.T
        if np.linalg.norm(self.T[:3, 3] - self.dropped_m) > DROP_SHARE * self.settings.map_radius_m:
            self.map.drop_far(self.T[:3, 3], self.settings.map_radius_m)
            self.dropped_m = self.T[:3, 3]

    def _is_keyframe(self, stamp_ns: int) -> bool:
        late = stamp_ns - self.keyframe_ns >= self.settings.keyframe_s * 1e9
        if not late and not moved(
            self.keyframe_T, self.T, self.settings.keyframe_m, self.settings.keyframe_rad
        ):
            return False
        self.keyframe_T, self.keyframe_ns = self.T, stamp_ns
        return True

    def _new_map(self) -> VoxelMap:
        return VoxelMap(self.settings.voxel_size_m, self.settings.points_per_voxel)


@dataclass(frozen=True)
class Found:
    """Motion since the last scan as registration found it."""

    T_last_now: F8
    covariance: F8
    inlier_ratio: float
    rmse_m: float
    seen: Degeneracy
    reliable: bool
    well_seen: bool

    @classmethod
    def nothing(cls, prediction: Prediction) -> Found:
        """The scan or the map is empty."""
        return cls(prediction.T_last_now, prediction.covariance, 0.0, float("nan"), blind(), False, False)


class RunningDeviation:
    """How far predictions were off: root mean square of |t| + 2 r sin(angle / 2), m, over the last scans (KISS-ICP, eq. 6)."""

    MEMORY = 20.0

    def __init__(self, first_m: float) -> None:
        self._square_sum, self._count = first_m**2, 1.0

    @property
    def rms_m(self) -> float:
        return float(np.sqrt(self._square_sum / self._count))

    def add(self, T_error: F8, range_m: float) -> None:
        xi = se3_log(T_error)
        off = np.linalg.norm(T_error[:3, 3]) + 2 * range_m * np.sin(0.5 * np.linalg.norm(xi[:3]))
        keep = min(1.0, self.MEMORY / (self._count + 1))
        self._square_sum = (self._square_sum + float(off) ** 2) * keep
        self._count = (self._count + 1) * keep


def moved(T_a: F8, T_b: F8, distance_m: float, angle_rad: float) -> bool:
    """Whether two poses are at least this far or this much turned from each other."""
    xi = se3_log(inverse(T_a) @ T_b)
    return bool(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]) >= distance_m or np.linalg.norm(xi[:3]) >= angle_rad)


def orthonormal(T: F8) -> F8:
    """The pose with rounding removed from its rotation."""
    left, _, right = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = left @ right
    return out
