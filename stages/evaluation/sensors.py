"""Figures of what the scans said of the other sensors; nothing here needs truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scanloom.schemas.cameras import CameraCheck
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


def camera_figures(check: CameraCheck) -> Iterator[Figure]:
    """How well the cameras agree with the reflectance; nothing for a session without cameras."""
    if not check.cameras:
        return
    against = "images against the reflectance of the scans"
    for camera in check.cameras:
        name = f"camera.{camera.camera}"
        yield Figure(f"{name}.nid", camera.nid, "", f"normalised information distance, {against}")
        yield Figure(f"{name}.offset_deg", camera.turned_deg, "deg", f"turn at which it fits best, {against}")
        yield Figure(
            f"{name}.offset_std_deg",
            float(np.linalg.norm(camera.std_deg)),
            "deg",
            "of that, by leaving out images part by part",
        )
    moved = sum(camera.verdict == "moved" for camera in check.cameras)
    yield Figure("camera.moved", moved, "", f"cameras that have turned since their calibration, {against}")
