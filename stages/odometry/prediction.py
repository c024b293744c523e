"""What motion to expect before a scan is looked at: from gyro and wheels, else as fast as before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, se3_log
from scanloom.stages.geometry.traction import WheelScale, without_slips
from scanloom.stages.odometry.slip import SlipGate

GYRO_STD_RAD_PER_SQRT_S = 0.002
WHEEL_STD_SHARE = 0.02
GUESS_RATE_STD_RAD_S = 0.5
GUESS_ACCELERATION_STD_M_S2 = 3.0
GUESS_SPEED_STD_M_S = 15.0
SLIP_M_S = 0.5
MIN_STEP_M = 0.1
MAX_SCALE_ERROR = 0.1


@dataclass(frozen=True)
class Prediction:
    """Expected motion since the last scan: pose of the LiDAR now in the LiDAR then, and its covariance (6, 6).

    `steady` is the same for a motion that goes on as before, whatever the sensors say: wheels may slip.
    """

    T_last_now: F8
    steady: F8
    covariance: F8
    measured: bool
    """True when gyro and wheels cover the time: then a scan must see a direction clearly to overrule them."""
    known: bool
    """False when neither sensors nor earlier scans tell anything."""


class Predictor:
    """Expected motion between scans.

    Rotation from the gyro and translation from the wheels where they cover the time, else both at the rate of the
    last registered motion. Slips of the wheels are taken out first, for the whole log (see `traction`); what is left of them
    is bounded by the accelerometer. The wheels' scale is estimated from well registered scans: LiDAR over wheel displacement
    along x of the base; steps where the two differ by more than 0.5 m/s are slip and left out (methods 1.8).
    """

    def __init__(self, session: Session, imu: Imu, wheel: Wheel) -> None:
        self._traction = without_slips(wheel, imu, session)
        self._track = MotionTrack.build(imu, self._traction.wheel, session)
        self._T_base_lidar = np.array(session.T_base("lidar"))
        self._twist: F8 | None = None
        self._seen_ns: int | None = None
        self._gate = SlipGate(session, imu)
        self._scale = WheelScale()

    @property
    def wheel_scale(self) -> float:
        """LiDAR metres per wheel metre."""
        return self._scale.value

    def predict(self, last_ns: int, now_ns: int) -> Prediction:
        """Motion of the LiDAR between two reference times."""
        cover = self._track.covers(last_ns, now_ns)
        T = self._track.relative(last_ns, now_ns, self._twist)
        slip_m = 0.0
        if cover.translation:
            T, slip_m = self._corrected(T, last_ns, now_ns)
        covariance = self._covariance(T, last_ns, now_ns, cover.rotation, cover.translation)
        covariance[3:, 3:] += np.eye(3) * slip_m**2
        steady = T if self._twist is None else se3_exp(self._twist * 1e-9 * (now_ns - last_ns))
        measured = cover.rotation and cover.translation
        return Prediction(T, steady, covariance, measured, self._twist is not None or cover.translation)

    def learn(self, last_ns: int, now_ns: int, T_last_now: F8, *, well_seen: bool) -> None:
        """Take note of the motion that was found; `well_seen`: along every direction by the scan itself."""
        dt = 1e-9 * (now_ns - last_ns)
        if dt <= 0:
            return
        self._twist = se3_log(T_last_now) / dt
        self._gate.learn(self._forward(T_last_now) / dt, last_ns, now_ns, well_seen=well_seen)
        if well_seen:
            self._seen_ns = now_ns
        grip = self._track.covers(last_ns, now_ns).translation and not self._traction.slipped(last_ns, now_ns)
        if well_seen and grip:
            self._learn_scale(
                self._forward(self._track.relative(last_ns, now_ns)), self._forward(T_last_now), dt
            )

    def _learn_scale(self, wheel_m: float, lidar_m: float, dt: float) -> None:
        off = abs(lidar_m - self.wheel_scale * wheel_m)
        if abs(wheel_m) < MIN_STEP_M or off > min(SLIP_M_S * dt, MAX_SCALE_ERROR * abs(wheel_m)):
            return
        self._scale.learn(wheel_m, lidar_m)

    def _forward(self, T_lidar: F8) -> float:
        """Displacement of the base origin along x of the base."""
        return float((self._T_base_lidar @ T_lidar @ inverse(self._T_base_lidar))[0, 3])

    def _corrected(self, T_lidar: F8, last_ns: int, now_ns: int) -> tuple[F8, float]:
        """The wheels' motion with their scale, without slip; and how much slip was taken off, m."""
        T_base = self._T_base_lidar @ T_lidar @ inverse(self._T_base_lidar)
        T_base[:3, 3] *= self.wheel_scale
        dt = 1e-9 * (now_ns - last_ns)
        slip_m = float(T_base[0, 3] - self._gate.bounded(T_base[0, 3] / dt, last_ns, now_ns) * dt)
        T_base[0, 3] -= slip_m
        return inverse(self._T_base_lidar) @ T_base @ self._T_base_lidar, slip_m

    def _covariance(self, T: F8, last_ns: int, now_ns: int, rotation: bool, translation: bool) -> F8:
        """Independent errors of rotation and translation, isotropic, growing with time and way.

        A guess is the worse the longer ago all of the motion was seen: its speed may have changed since.
        """
        dt = 1e-9 * (now_ns - last_ns)
        way = float(np.linalg.norm(T[:3, 3]))
        unseen_s = 1e-9 * (now_ns - self._seen_ns) if self._seen_ns is not None else np.inf
        turn_std = GYRO_STD_RAD_PER_SQRT_S * np.sqrt(dt) if rotation else GUESS_RATE_STD_RAD_S * dt
        speed_std = min(GUESS_ACCELERATION_STD_M_S2 * unseen_s, GUESS_SPEED_STD_M_S)
        way_std = WHEEL_STD_SHARE * way if translation else speed_std * dt
        return np.diag([turn_std**2 + 1e-8] * 3 + [way_std**2 + 1e-6] * 3)


FORWARD_GUESSES_M = (0.0, 1.0, -1.0, 2.0, 3.0)


def forward_guesses(T_base_lidar: F8) -> list[F8]:
    """Motions of the LiDAR (4, 4) to try when nothing is known: the vehicle stands, or drives ahead or back."""
    return [
        inverse(T_base_lidar) @ se3_exp([0, 0, 0, step, 0, 0]) @ T_base_lidar for step in FORWARD_GUESSES_M
    ]
