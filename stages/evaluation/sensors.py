"""Figures of what the scans said of the other sensors; nothing here needs truth."""

from __future__ import annotations

from collections.abc import Iterator

from scanloom.schemas.rig import SensorCheck
from scanloom.stages.evaluation.figures import Figure


def sensor_figures(check: SensorCheck) -> Iterator[Figure]:
    """Clock offsets and scale as measured, corrected or not; what could not be measured is NaN and left out later."""
    against = "against the motion between neighbouring scans"
    yield Figure(
        "sensors.imu_clock_offset_s", check.imu.measured_offset_s, "s",
        f"how much later the IMU's stamps are than the LiDAR's, turn rates {against}",
    )  # fmt: skip
    yield Figure(
        "sensors.wheel_clock_offset_s", check.wheel.measured_offset_s, "s",
        f"how much later the wheels' stamps are than the LiDAR's, speeds {against}",
    )  # fmt: skip
    yield Figure(
        "sensors.wheel_ratio",
        check.wheel.measured_ratio,
        "",
        f"true speed over the wheels' as logged, {against}",
    )
    contradicting = sum(each.verdict == "contradicts" for each in (check.imu, check.wheel))
    yield Figure(
        "sensors.contradicting", contradicting, "", "IMU and wheels that fit the motion in no known way"
    )
