"""Motion of the vehicle from its gyro and its wheels: how the LiDAR moved between any two times.

How to use it (deskew does, odometry may):

    track = MotionTrack.build(imu, wheel, session)          # whole-session tables; cheap, nothing is integrated yet
    track.has_rotation, track.has_translation                # which sensors are usable at all
    cover = track.covers(t_a_ns, t_b_ns)                     # Coverage(rotation: bool, translation: bool) of a stretch
    T_a_b = track.relative(t_a_ns, t_b_ns)                   # (4, 4): LiDAR at b in the LiDAR frame at a
    T_ref_t = track.poses(at_ns, reference_ns)               # (m, 4, 4): LiDAR at each time in its frame at reference
    track.gyro_bias_rad_s, track.standstill                  # (3,) in the IMU frame; (k, 2) intervals in ns

Where rotation is not covered it is taken as none, and where translation is not covered the base origin is taken as
standing: ask `covers` first, or pass a `twist` of the LiDAR (from registration, say) that stands in for what is
missing. Model (methods 1.4): attitude from the bias-free gyro, wheel speed along x of the base at the wheels'
position, no side slip, lever arms through the extrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.travel import travel

I8 = NDArray[np.int64]

MAX_GYRO_RAD_S = 35.0  # 2000 deg/s, the range of the fastest common gyros
MAX_SPEED_M_S = 100.0
CREEP_M_S, STILL_SPEED_M_S = 0.15, 0.02
STILL_GYRO_STD_RAD_S = 0.02
STILL_ACCEL_STD_M_S2 = 0.25
MAX_BIAS_RAD_S = 0.05
LEAST_SAMPLES = 8
MAX_MEAN_TILT_RAD = np.radians(45.0)
NOTHING = np.zeros((0, 2), np.int64)
NO_STAMPS, ANY_TIME = np.zeros(0, np.int64), np.zeros(1, np.int64)
STANDING = (ANY_TIME, np.zeros((1, 3)), np.zeros((1, 3)))


@dataclass(frozen=True)
class Coverage:
    """Which parts of the motion over a stretch of time the sensors tell."""

    rotation: bool
    translation: bool


class Twists(NamedTuple):
    """Twists (k, 6) of the LiDAR at increasing times (k,): rotation rate and velocity in its own frame, rad/s, m/s."""

    stamp_ns: I8
    value: F8

    @classmethod
    def of(cls, twist: F8 | Twists) -> Twists:
        """A single twist (6,) holds throughout."""
        return (
            twist if isinstance(twist, Twists) else cls(ANY_TIME, np.ascontiguousarray(twist).reshape(1, 6))
        )


@dataclass(frozen=True)
class MotionTrack:
    """Angular rate and speed of the vehicle over time. See the module for its use."""

    gyro_ns: I8
    rate_base: F8
    """(n, 3) angular rate in the base frame without bias, rad/s."""
    wheel_ns: I8
    speed_m_s: F8
    T_base_lidar: F8
    wheel_position: F8
    """(3,) the point without side slip, in the base frame, m."""
    gyro_bias_rad_s: F8
    standstill: I8
    max_gyro_gap_ns: int = 300_000_000
    max_wheel_gap_ns: int = 1_000_000_000

    @classmethod
    def build(
        cls, imu: Imu, wheel: Wheel, session: Session, *,
        wheel_scale: float = 1.0, max_gyro_gap_s: float = 0.3, max_wheel_gap_s: float = 1.0,
    ) -> MotionTrack:  # fmt: skip
        """From the sensors of a session.

        Rows with NaN, absurd values or a repeated stamp are dropped. An IMU whose gravity does not point up within
        45 degrees has wrong extrinsics and is not used. Without a gyro the wheels' own turn rate is used if given.
        """
        T_base_imu = np.array(session.T_base("imu"))
        wheel_ns, speed, yaw_rate = _clean_wheel(wheel)
        imu_ns, gyro, accel = _clean_imu(imu)
        if not gravity_points_up(accel, T_base_imu):
            imu_ns, gyro, accel = imu_ns[:0], gyro[:0], accel[:0]
        still = standstill_intervals(wheel_ns, speed, imu_ns, gyro, accel)
        bias = gyro_bias(imu_ns, gyro, still)
        rate = (gyro - bias) @ T_base_imu[:3, :3].T
        if len(imu_ns) == 0 and np.isfinite(yaw_rate).any():
            turning = np.isfinite(yaw_rate)
            imu_ns, rate = (
                wheel_ns[turning],
                np.column_stack((*np.zeros((2, turning.sum())), yaw_rate[turning])),
            )
        return cls(
            imu_ns, rate, wheel_ns, speed * wheel_scale, np.array(session.T_base("lidar")),
            np.array(session.T_base("wheel"))[:3, 3].copy(), bias, still,
            round(max_gyro_gap_s * 1e9), round(max_wheel_gap_s * 1e9),
        )  # fmt: skip

    @property
    def has_rotation(self) -> bool:
        return len(self.gyro_ns) > 1

    @property
    def has_translation(self) -> bool:
        return len(self.wheel_ns) > 1

    def covers(self, start_ns: int, end_ns: int) -> Coverage:
        """Which parts of the motion from `start_ns` to `end_ns` (in either order) the sensors tell without a long gap."""
        start, end = min(start_ns, end_ns), max(start_ns, end_ns)
        return Coverage(
            rotation=_without_gap(self.gyro_ns, start, end, self.max_gyro_gap_ns),
            translation=_without_gap(self.wheel_ns, start, end, self.max_wheel_gap_ns),
        )

    def relative(self, a_ns: int, b_ns: int, twist: F8 | Twists | None = None) -> F8:
        """T_a_b (4, 4) of the LiDAR between two times; `twist` as for `poses`."""
        T_a_b: F8 = self.poses(np.array([b_ns]), a_ns, twist)[0]
        return T_a_b

    def poses(self, at_ns: I8, reference_ns: int, twist: F8 | Twists | None = None) -> F8:
        """T_reference_t (m, 4, 4) of the LiDAR at the times `at_ns` (m,), in any order.

        twist : (6,) rotation rate and velocity of the LiDAR in its own frame (rad/s, m/s), or several with their times;
            stands in for what the sensors do not cover between the first and the last time.
        No motion gives exact identities.
        """
        at_ns = np.asarray(at_ns, np.int64)
        if len(at_ns) == 0:
            return np.zeros((0, 4, 4))
        first, last = min(int(at_ns.min()), reference_ns), max(int(at_ns.max()), reference_ns)
        cover = self.covers(first, last)
        known = None if twist is None else Twists.of(twist)
        T_reference_lidar: F8 = travel(
            at_ns, reference_ns, first, last, self.gyro_ns if cover.rotation else NO_STAMPS, self.rate_base,
            self.wheel_ns if cover.translation else NO_STAMPS, self.speed_m_s, *self._steady(known),
            self._point(cover, known), self.T_base_lidar,
        )  # fmt: skip
        return T_reference_lidar

    def _steady(self, twists: Twists | None) -> tuple[I8, F8, F8]:
        """Times, angular rates and velocities of the LiDAR in axes of the base that stand in for missing sensors."""
        if twists is None:
            return STANDING
        R = self.T_base_lidar[:3, :3]
        return twists.stamp_ns, twists.value[:, :3] @ R.T, twists.value[:, 3:] @ R.T

    def _point(self, cover: Coverage, twists: Twists | None) -> F8:
        """Point of the base whose velocity is known: of the wheels, or of the LiDAR; without either the origin stands."""
        if cover.translation:
            return self.wheel_position
        return np.zeros(3) if twists is None else self.T_base_lidar[:3, 3].copy()


# ---------------------------------------------------------------------------------------------------------------------


def standstill_intervals(
    wheel_ns: I8, speed_m_s: F8, imu_ns: I8, gyro: F8, accel: F8, *, least_s: float = 0.8
) -> I8:
    """Intervals (k, 2), ns, in which the vehicle stood for more than `least_s`.

    By the wheels where there are any; else by an IMU that shakes as little as one at rest and hardly turns.
    """
    if len(wheel_ns) > 1:
        return _runs(wheel_ns, _standing(wheel_ns, speed_m_s), round(least_s * 1e9))
    if len(imu_ns) < LEAST_SAMPLES:
        return NOTHING
    second = (imu_ns - imu_ns[0]) // round(least_s * 1e9)
    first, count = np.unique(second, return_index=True, return_counts=True)[1:]
    gyro_mean, gyro_std = _spread(gyro, first, count)
    accel_std = _spread(accel, first, count)[1]
    quiet = (
        (count >= LEAST_SAMPLES)
        & (gyro_std < STILL_GYRO_STD_RAD_S)
        & ~(accel_std > STILL_ACCEL_STD_M_S2)  # an IMU without accelerometer gives NaN
        & (np.linalg.norm(gyro_mean, axis=1) < MAX_BIAS_RAD_S)
    )
    still: I8 = np.column_stack((imu_ns[first], imu_ns[first + count - 1]))[quiet]
    return still


def _spread(value: F8, first: NDArray[np.intp], count: NDArray[np.intp]) -> tuple[F8, F8]:
    """Mean (k, 3) of each group of rows, and the largest standard deviation (k,) of its columns."""
    mean = np.add.reduceat(value, first) / count[:, None]
    centered = value - np.repeat(mean, count, axis=0)
    return mean, np.sqrt((np.add.reduceat(centered**2, first) / count[:, None]).max(axis=1))


def gyro_bias(imu_ns: I8, gyro: F8, standstill: I8) -> F8:
    """Mean gyro output (3,), rad/s, while the vehicle stood: the median over its stops; zero when it never stood."""
    means = []
    for start, end in standstill:
        part = gyro[np.searchsorted(imu_ns, start) : np.searchsorted(imu_ns, end, side="right")]
        if len(part) >= LEAST_SAMPLES and np.all(part.std(axis=0) < STILL_GYRO_STD_RAD_S):
            means.append(part.mean(axis=0))
    if not means:
        return np.zeros(3)
    bias: F8 = np.median(means, axis=0)
    return bias if np.all(np.abs(bias) < MAX_BIAS_RAD_S) else np.zeros(3)


def gravity_points_up(accel: F8, T_base_imu: F8) -> bool:
    """Whether the mean specific force is upward in the base frame; true when there is none to judge by."""
    some = accel[:: max(1, len(accel) // 10_000)]
    known = some[np.isfinite(some).all(axis=1)]
    if len(known) == 0:
        return True
    up = T_base_imu[:3, :3] @ np.median(known, axis=0)
    norm = float(np.linalg.norm(up))
    return norm < 5.0 or up[2] > norm * np.cos(MAX_MEAN_TILT_RAD)


def _standing(wheel_ns: I8, speed_m_s: F8) -> NDArray[np.bool_]:
    """Where the speed is nothing but noise: small, and smaller yet in the mean over half a second."""
    period_ns = max(float(np.median(np.diff(wheel_ns))), 1.0)
    window = int(np.clip(round(0.5e9 / period_ns), 1, len(wheel_ns)))
    mean = np.convolve(speed_m_s, np.full(window, 1.0 / window), mode="same")
    return (np.abs(speed_m_s) < CREEP_M_S) & (np.abs(mean) < STILL_SPEED_M_S)


def _runs(stamp_ns: I8, holds: NDArray[np.bool_], least_ns: int) -> I8:
    """Intervals (k, 2) in which `holds` is true throughout and which last at least `least_ns`."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], holds, [False])).astype(np.int8)))
    spans = np.column_stack((stamp_ns[edges[::2]], stamp_ns[edges[1::2] - 1]))
    kept: I8 = spans[spans[:, 1] - spans[:, 0] > least_ns]
    return kept


def _clean_imu(imu: Imu) -> tuple[I8, F8, F8]:
    good = np.isfinite(imu.gyro_rad_s).all(axis=1) & (np.abs(imu.gyro_rad_s) < MAX_GYRO_RAD_S).all(axis=1)
    rows = _ordered(imu.stamp_ns, np.flatnonzero(good))
    return imu.stamp_ns[rows], imu.gyro_rad_s[rows], imu.accel_m_s2[rows]


def _clean_wheel(wheel: Wheel) -> tuple[I8, F8, F8]:
    good = np.isfinite(wheel.speed_m_s) & (np.abs(wheel.speed_m_s) < MAX_SPEED_M_S)
    rows = _ordered(wheel.stamp_ns, np.flatnonzero(good))
    return wheel.stamp_ns[rows], wheel.speed_m_s[rows], wheel.yaw_rate_rad_s[rows]


def _ordered(stamp_ns: I8, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """The rows by increasing stamp, the first of equal stamps."""
    return rows[np.unique(stamp_ns[rows], return_index=True)[1]]


def _without_gap(stamp_ns: I8, start: int, end: int, longest_ns: int) -> bool:
    """Whether the samples around [start, end] are never further apart than `longest_ns`, nor end earlier than that."""
    if len(stamp_ns) < 2 or start < stamp_ns[0] - longest_ns or end > stamp_ns[-1] + longest_ns:
        return False
    i = max(int(np.searchsorted(stamp_ns, start, side="right")) - 1, 0)
    j = min(int(np.searchsorted(stamp_ns, end)), len(stamp_ns) - 1)
    return j <= i or bool(np.diff(stamp_ns[i : j + 1]).max() <= longest_ns)
