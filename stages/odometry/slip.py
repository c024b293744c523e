"""Wheels that slip: what they say of a change of speed must agree with the accelerometer."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu
from scanloom.stages.geometry.se3 import F8

TOLERANCE_M_S2 = 1.5
"""What slopes, pitching and the lever arm of the IMU may add to the forward acceleration."""
BLIND_TOLERANCE_M_S2 = 6.0
"""Without accelerometer: more than a car brakes or accelerates."""
OFFSET_GAIN = 0.03


class SlipGate:
    """Bounds the forward speed by the last known one and the acceleration since.

    Speeds are means over the time between two scans, so the acceleration is averaged from the middle of the last
    interval to the middle of this one. Its offset (gravity on a slope, bias) is learned slowly from scans that saw all.
    """

    def __init__(self, session: Session, imu: Imu) -> None:
        accel = imu.accel_m_s2 @ np.array(session.T_base("imu"))[0, :3]
        good = np.isfinite(accel)
        self._stamp_ns = imu.stamp_ns[good]
        self._sum: F8 = np.concatenate(([0.0], np.cumsum(accel[good])))
        self._offset_m_s2 = 0.0
        self._middle_ns = 0
        self._speed_m_s: float | None = None

    def bounded(self, speed_m_s: float, last_ns: int, now_ns: int) -> float:
        """The speed, or the nearest one that the last speed and the acceleration allow."""
        if self._speed_m_s is None:
            return speed_m_s
        middle_ns = (last_ns + now_ns) // 2
        accel = self._mean(self._middle_ns, middle_ns)
        expected = self._speed_m_s + 1e-9 * (middle_ns - self._middle_ns) * (
            0.0 if accel is None else accel - self._offset_m_s2
        )
        tolerance = BLIND_TOLERANCE_M_S2 if accel is None else TOLERANCE_M_S2
        reach = tolerance * 1e-9 * (middle_ns - self._middle_ns)
        return float(np.clip(speed_m_s, expected - reach, expected + reach))

    def learn(self, speed_m_s: float, last_ns: int, now_ns: int, *, well_seen: bool) -> None:
        """Take note of the speed that was found between two scans."""
        middle_ns = (last_ns + now_ns) // 2
        accel = self._mean(self._middle_ns, middle_ns)
        if well_seen and self._speed_m_s is not None and accel is not None:
            change = (speed_m_s - self._speed_m_s) / (1e-9 * (middle_ns - self._middle_ns))
            self._offset_m_s2 += OFFSET_GAIN * (accel - change - self._offset_m_s2)
        self._middle_ns, self._speed_m_s = middle_ns, speed_m_s

    def _mean(self, start_ns: int, end_ns: int) -> float | None:
        """Mean forward acceleration; None without measurements."""
        i, j = np.searchsorted(self._stamp_ns, (start_ns, end_ns))
        return float((self._sum[j] - self._sum[i]) / (j - i)) if j > i else None
