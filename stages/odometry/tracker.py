"""One scan after the other onto the local map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.stages.geometry.degeneracy import Degeneracy, blind, judge
from scanloom.stages.geometry.registration import Registration, SurfelMap, align
from scanloom.stages.geometry.se3 import F8, inverse, se3_log, transform
from scanloom.stages.odometry.aside import Aside, Unconfirmed, unknown_motion
from scanloom.stages.odometry.belief import Belief
from scanloom.stages.odometry.poses import apart, orthonormal
from scanloom.stages.odometry.prediction import Prediction, Predictor, forward_guesses
from scanloom.stages.odometry.recovery import Attempt, Recovery
from scanloom.stages.odometry.rows import Row, Rows
from scanloom.stages.odometry.settings import Settings
from scanloom.stages.odometry.thinning import ThinScan

MIN_POINTS = 50
FEW_FIRST = 4
MIN_INLIERS = 30
MIN_INLIERS_OF_MATCHES = 0.4
FADING = 0.9
MAX_BRIDGED = 10
MAX_FRUITLESS, SELDOM = 10, 10
"""After so many searches in succession that found nothing, only every tenth scan is searched for."""
DROP_SHARE = 0.1
"""Of the local map's radius: after this way what is too far is dropped. Each time the whole map is copied."""


class Tracker:
    """State between scans: pose, local map, last keyframe, and how well predictions have been.

    A scan that does not fit where it is expected is searched for around; one that is found by surprise enters the map when
    the next scan agrees. Scans that fit nowhere are bridged by prediction; where sensors do not tell the motion either,
    they become a segment of their own. Either way they are kept aside, and go on as the map when they fit each other.
    """

    def __init__(self, settings: Settings, predictor: Predictor, T_base_lidar: F8) -> None:
        self.settings = settings
        self.predictor = predictor
        self.guesses = forward_guesses(T_base_lidar)
        self.voxel_size_m = settings.voxel_size_m
        self.normals: F8 | None = None
        self.map = self._new_map()
        self.T = np.eye(4)
        self.last_ns = 0
        self.rows = Rows()
        self.bridged = 0
        self.deviation = RunningDeviation(settings.first_deviation_m)
        self.inlier_ratio = 0.0
        self.keyframe_T, self.keyframe_ns = np.eye(4), 0
        self.inserted_T = np.eye(4)
        self.dropped_m = np.zeros(3)
        self.recovery = Recovery(T_base_lidar)
        self.floor = settings.floor
        self.belief = Belief(self.floor)
        self.fruitless = 0
        self.aside: Aside | None = None
        self.unconfirmed: Unconfirmed | None = None

    def step(self, scan: ThinScan) -> None:
        """Take the next scan; its row is the last of `rows`."""
        self.voxel_size_m, self.normals = scan.voxel_size_m, scan.normals
        if not len(self.rows):
            self.map = self._new_map()
            self.rows.add(self._begin(scan.scan_index, scan.stamp_ns, scan.fine))
            return
        prediction = self.predictor.predict(self.last_ns, scan.stamp_ns)
        before = Unconfirmed.of(self.T, scan.fine, self.last_ns, scan.stamp_ns, prediction)
        found = self._register(scan.coarse, prediction, self.map)
        if self.unconfirmed is not None and (found.searched or not found.reliable):
            found = self._second_thoughts(scan, prediction, found)
        in_map = found.reliable
        if not in_map:
            found = self._register_aside(scan, prediction, found)
        self._move(scan.stamp_ns, prediction, found, in_map)
        self.rows.add(
            Row(
                scan.scan_index,
                scan.stamp_ns,
                self.T,
                found.covariance,
                found.inlier_ratio,
                found.rmse_m,
                found.seen,
                self._is_keyframe(scan.stamp_ns),
                found.reliable,
            )
        )
        if in_map:
            self.rows.settle(before.T_before @ prediction.T_last_now, prediction.covariance)
        self._confirm(before.found(self.T, sure=found.sure) if found.searched else None, in_map)
        self._extend_map(scan, prediction, in_map)

    def _begin(self, index: int, stamp_ns: int, fine: F8) -> Row:
        self.map.insert(fine)
        self.last_ns = self.keyframe_ns = stamp_ns
        enough = len(fine) >= MIN_POINTS
        return Row(index, stamp_ns, self.T, self.floor, 1.0 if enough else 0.0, 0.0, blind(), True, enough)

    def _register(self, coarse: F8, prediction: Prediction, target: SurfelMap) -> Found:
        """Align to the map from the prediction; directions the scan does not tell stay as predicted."""
        if len(coarse) < MIN_POINTS or len(target) < MIN_POINTS:
            return Found.nothing(prediction)
        attempt = self._attempt(coarse, prediction, target)
        return self._found(attempt, coarse, prediction, target)

    def _found(self, attempt: Attempt, coarse: F8, prediction: Prediction, target: SurfelMap) -> Found:
        """What a registration tells. A scan that was searched for has no expected motion for what it does not see."""
        registration = attempt.registration
        seen = self._judge(registration, prediction)
        weak = seen.p < self.settings.least_p
        reliable = attempt.believed and not (attempt.searched and prediction.known and weak.any())
        if weak.any() and prediction.known and not attempt.searched:
            free = seen.observed(self.settings.least_p)
            registration = self._align_expected(coarse, prediction, target, free)
            reliable = reliable and self._credible(registration, len(coarse), prediction)
        information = seen.scan_information(self.settings.least_p, self.settings.covariance_inflation)
        belief, covariance = self._believed().registered(prediction, information)
        return Found(
            inverse(self.T) @ registration.T_target_source,
            covariance + self.floor if reliable else prediction.covariance,
            registration.inlier_ratio,
            registration.rmse_m,
            seen,
            reliable,
            not weak.any(),
            attempt.searched,
            attempt.sure,
            self.recovery.fit(registration, len(coarse)),
            belief,
        )

    def _believed(self) -> Belief:
        """What is known of the last pose. While lost the motion counts from where the map was left (see `Rows.settle`)."""
        return Belief(self.floor) if self.rows.lost else self.belief

    def _attempt(self, coarse: F8, prediction: Prediction, target: SurfelMap) -> Attempt:
        """From the prediction; where that fails (slip, nothing known yet) the best from other starts, else searched for."""
        expected, n = self.T @ prediction.T_last_now, len(coarse)
        first = self._align_expected(coarse, prediction, target)
        tries = [first] if self._credible(first, n, prediction) else []
        if prediction.known and tries and not self.recovery.doubts(first, n):
            return Attempt(first, searched=False, believed=True)
        others = (prediction.steady,) if prediction.known else self.guesses
        tries += self._credible_from([self.T @ start for start in others], coarse, prediction, target)
        if prediction.known and tries:
            best = max(tries, key=lambda r: self.recovery.fit(r, n))
            if not self.recovery.doubts(best, n):
                return Attempt(best, searched=False, believed=True)
        if not tries and self._slid(first, coarse, prediction, target):
            return Attempt(first, searched=False, believed=True)
        if self.fruitless > MAX_FRUITLESS and len(self.rows) % SELDOM:
            return Attempt(tries[0] if tries else first, searched=False, believed=bool(tries))
        attempt = self.recovery.search(
            tries, lambda T: self._align(coarse, T, target), lambda r: self._sound(r, n), target.points(), coarse,
            expected, prediction,
        )  # fmt: skip
        self.fruitless = 0 if attempt is not None and attempt.believed else self.fruitless + 1
        return attempt or Attempt(first, searched=False, believed=False)

    def _judge(self, registration: Registration, prediction: Prediction) -> Degeneracy:
        snr = self.settings.measured_snr if prediction.measured else self.settings.snr
        return judge(
            registration, point_noise_m=self.settings.point_noise_m, snr=snr, kind=self.settings.indicator
        )

    def _slid(
        self, registration: Registration, coarse: F8, prediction: Prediction, target: SurfelMap
    ) -> bool:
        """Whether a registration is not credible only because it slid along directions that the scan does not tell."""
        seen = self._judge(registration, prediction)
        if (seen.p >= self.settings.least_p).all():
            return False
        free = seen.observed(self.settings.least_p)
        held = self._align_expected(coarse, prediction, target, free)
        n = len(coarse)
        return self._credible(held, n, prediction) and not self.recovery.doubts(held, n)

    def _credible_from(
        self, starts: Sequence[F8], coarse: F8, prediction: Prediction, target: SurfelMap
    ) -> list[Registration]:
        tries = [self._align(coarse, start, target) for start in starts]
        return [r for r in tries if self._credible(r, len(coarse), prediction)]

    def _second_thoughts(self, scan: ThinScan, prediction: Prediction, found: Found) -> Found:
        """The scan before was found by surprise, and this one does not follow from it: was that one wrong?

        So it was when this scan fits where it would be expected if that one had never been.
        """
        doubted, self.unconfirmed = self.unconfirmed, None
        if doubted is None or doubted.sure or len(scan.coarse) < MIN_POINTS:
            return found
        if not doubted.expectable:
            self.rows.withdraw(doubted.covariance)
            return found
        again = self._align(scan.coarse, doubted.expected(scan.stamp_ns), self.map)
        n = len(scan.coarse)
        if not self._sound(again, n) or self.recovery.doubts(again, n):
            return found
        self.rows.withdraw(doubted.covariance)
        return self._found(Attempt(again, searched=True, believed=True), scan.coarse, prediction, self.map)

    def _register_aside(self, scan: ThinScan, prediction: Prediction, found: Found) -> Found:
        """The scan fits nowhere in the map: register it to those lost before it, else begin with it anew."""
        if len(scan.coarse) < MIN_POINTS:
            return found
        if self.aside is not None:
            again = self._register(scan.coarse, prediction, self.aside.map)
            if again.reliable:
                return again
        pause_s = 1e-9 * (scan.stamp_ns - self.last_ns)
        told = prediction.covariance if prediction.measured else unknown_motion(prediction, pause_s)
        self.aside = Aside(self._new_map(), len(self.rows), prediction.measured, told)
        return found

    def _align_expected(
        self, coarse: F8, prediction: Prediction, target: SurfelMap, free: F8 | None = None
    ) -> Registration:
        """From the predicted pose, which counts as far as it is known; not at all while the map is lost."""
        known = prediction.known and not self.rows.lost and self.settings.least_p > 0
        held = np.asarray(np.linalg.inv(self.belief.expected(prediction)), np.float64) if known else None
        return self._align(coarse, self.T @ prediction.T_last_now, target, free, held)

    def _align(
        self, coarse: F8, T: F8, target: SurfelMap, free: F8 | None = None, held: F8 | None = None
    ) -> Registration:
        scale = float(np.clip(self.deviation.rms_m, self.settings.least_scale_m, self.settings.most_scale_m))
        return align(
            target, coarse, T, max_distance_m=target.voxel_size_m, scale_m=scale,
            max_iterations=self.settings.max_iterations, free=free, held=held, source_normals=self.normals,
            few_first=FEW_FIRST,
        )  # fmt: skip

    def _credible(self, registration: Registration, points: int, prediction: Prediction) -> bool:
        """Converged, on enough of the scan, and not further from the prediction than motion can explain."""
        if not self._sound(registration, points):
            return False
        if not prediction.known:
            return True
        if registration.inlier_ratio < 0.5 * self.inlier_ratio:
            return False
        correction = se3_log(inverse(self.T @ prediction.T_last_now) @ registration.T_target_source)
        bound_m = max(self.settings.least_bound_m, 5.0 * self.deviation.rms_m)
        too_far = np.linalg.norm(correction[3:]) > bound_m
        return not too_far and bool(np.linalg.norm(correction[:3]) < self.settings.bound_rad)

    def _sound(self, registration: Registration, points: int) -> bool:
        """Converged, on enough of the scan."""
        inliers = registration.inlier_ratio * points
        if not registration.converged or registration.inlier_ratio < self.settings.least_inlier_ratio:
            return False
        return inliers >= max(MIN_INLIERS, MIN_INLIERS_OF_MATCHES * len(registration.points))

    def _move(self, stamp_ns: int, prediction: Prediction, found: Found, in_map: bool) -> None:
        """Go to the new pose, and take note of the motion and of how well it was predicted."""
        T_last, last_ns, motion = self.T, self.last_ns, prediction.T_last_now
        if found.reliable:
            motion = found.T_last_now
            surprising = self.rows.lost or found.searched
            if prediction.known and not surprising:
                self.deviation.add(inverse(prediction.T_last_now) @ motion, found.seen.range_m)
            if in_map and self.rows.lost:
                T_last, last_ns = self.rows.T_sure, self.rows.sure_ns
        self.T, self.last_ns = orthonormal(self.T @ motion), stamp_ns
        if found.reliable:
            seen_motion = motion if last_ns == self.rows.last_ns else inverse(T_last) @ self.T
            self.predictor.learn(last_ns, stamp_ns, seen_motion, well_seen=found.well_seen)
        self.belief = found.belief if found.reliable and found.belief else self.belief.predicted(prediction)
        self._remember(found, in_map)

    def _remember(self, found: Found, in_map: bool) -> None:
        """How well scans usually fit the map, and for how long none did."""
        if in_map:
            share = found.inlier_ratio
            self.inlier_ratio += 0.1 * (share - self.inlier_ratio) if self.inlier_ratio else share
        else:
            self.inlier_ratio *= FADING
        self.recovery.learn(found.fit if in_map else None)
        self.bridged = 0 if in_map else self.bridged + 1

    def _confirm(self, surprise: Unconfirmed | None, in_map: bool) -> None:
        """A scan found by surprise waits for the next; one that waited enters the map when this one is registered."""
        if in_map and self.unconfirmed is not None:
            self.map.insert(self.unconfirmed.fine, self.unconfirmed.T)
        if in_map:
            self.unconfirmed = surprise

    def _extend_map(self, scan: ThinScan, prediction: Prediction, in_map: bool) -> None:
        """Add the scan when it was registered and the vehicle moved; start anew when the map was lost for long."""
        if in_map:
            self.aside = None
        elif self.aside is not None:
            self.aside.insert(transform(self.T, scan.fine))
        if self.aside is not None and self.aside.enough:
            if not self.aside.measured:
                self.rows.split(self.aside.first, self.aside.covariance)
            self.rows.sure = len(self.rows) - 1
            self._start_anew(self.aside.map)
            return
        if self.bridged >= MAX_BRIDGED or len(self.map) < MIN_POINTS:
            pause_s = 1e-9 * (scan.stamp_ns - self.rows.sure_ns)
            if not prediction.measured and self.bridged >= MAX_BRIDGED:
                self.rows.split(len(self.rows) - 1, unknown_motion(prediction, pause_s))
            self.rows.sure = len(self.rows) - 1
            self._start_anew(self._new_map())
        elif not in_map or self.unconfirmed is not None or not apart(
            self.inserted_T, self.T, self.settings.insert_m, self.settings.insert_rad
        ):  # fmt: skip
            return
        self.map.insert(scan.fine, self.T)
        self.inserted_T = self.T
        if np.linalg.norm(self.T[:3, 3] - self.dropped_m) > DROP_SHARE * self.settings.map_radius_m:
            self.map.drop_far(self.T[:3, 3], self.settings.map_radius_m)
            self.dropped_m = self.T[:3, 3]

    def _start_anew(self, new: SurfelMap) -> None:
        self.map, self.bridged, self.inlier_ratio, self.recovery.usual = new, 0, 0.0, 0.0
        self.inserted_T, self.aside, self.unconfirmed = self.T, None, None
        self.belief = Belief(self.floor)

    def _is_keyframe(self, stamp_ns: int) -> bool:
        late = stamp_ns - self.keyframe_ns >= self.settings.keyframe_s * 1e9
        if not late and not apart(
            self.keyframe_T, self.T, self.settings.keyframe_m, self.settings.keyframe_rad
        ):
            return False
        self.keyframe_T, self.keyframe_ns = self.T, stamp_ns
        return True

    def _new_map(self) -> SurfelMap:
        return SurfelMap(self.voxel_size_m)


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
    searched: bool = False
    """Found by a search, not where it was expected."""
    sure: bool = True
    """See `Attempt`."""
    fit: float = 0.0
    """See `Recovery.fit`."""
    belief: Belief | None = None
    """What is known of the pose in the map."""

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
