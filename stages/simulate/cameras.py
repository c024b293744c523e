"""Cameras on the vehicle: where they are, where the log says they are, and their lenses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanloom.schemas.cameras import Camera, CameraModel, Cameras
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, so3_exp
from scanloom.stages.simulate.rig import T_BASE, mount
from scanloom.stages.simulate.settings import Settings

NAMES = ("cam_front", "cam_left", "cam_right")
_PLACES = (
    ((1.75, 0.05, 1.62), (0.6, 7.0, -0.8)),
    ((1.30, 0.62, 1.60), (-0.9, 9.0, 78.0)),
    ((1.32, -0.60, 1.60), (0.5, 9.5, -81.0)),
)
"""Metres and degrees (roll, pitch, yaw) on the vehicle; all look down a little."""
_AXES = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Camera axes (right, down, forward) in those of something that looks along x."""
_BENDS = {
    "radial-tangential": (-0.19, 0.055, 4e-4, -3e-4, -0.006),
    "equidistant": (-0.014, 0.005, -0.002, 2e-4),
}
_FOCAL = {"radial-tangential": 0.62, "equidistant": 0.5}
"""Focal length as a share of the width."""


def model(settings: Settings, number: int) -> CameraModel:
    """The lens of a camera; no two are quite alike."""
    s = settings
    focal = _FOCAL[s.lens] * s.camera_width_px * (1.0 + 0.004 * number)
    return CameraModel(
        lens=s.lens,
        width_px=s.camera_width_px,
        height_px=s.camera_height_px,
        fx_px=focal,
        fy_px=1.001 * focal,
        cx_px=(0.503 - 0.002 * number) * s.camera_width_px - 0.5,
        cy_px=(0.494 + 0.003 * number) * s.camera_height_px - 0.5,
        distortion=_BENDS[s.lens],
    )


def true_mounts(settings: Settings) -> list[F8]:
    """T_base_camera of each camera, as it truly is when the drive starts: what the log says, off by a small error of
    the calibration, and turned about some axis since."""
    turned = np.radians(settings.camera_turned_deg)
    mounts = []
    for k, T in enumerate(told_mounts(settings)):
        rng = np.random.default_rng((settings.seed, 31, k))
        error = rng.standard_normal(6) * np.repeat(
            (np.radians(settings.camera_error_deg), settings.camera_error_m), 3
        )
        axis = rng.standard_normal(3)
        turn = np.eye(4)
        turn[:3, :3] = so3_exp(turned * axis / np.linalg.norm(axis))
        mounts.append(T @ se3_exp(error) @ turn)
    return mounts


def told_mounts(settings: Settings) -> list[F8]:
    """T_base_camera of each camera, as the log's tf says."""
    return [mount(*place) @ _AXES for place in _PLACES[: settings.cameras]]


def optical(name: str) -> str:
    """Frame of a camera's axes."""
    return f"{name}_optical"


def true_cameras(settings: Settings) -> Cameras:
    """For evaluation: every camera with its true place on the LiDAR."""
    to_lidar = inverse(T_BASE["lidar"])
    return cameras_at(settings, [to_lidar @ T for T in true_mounts(settings)])


def cameras_at(settings: Settings, poses: Sequence[F8]) -> Cameras:
    """The cameras at given T_lidar_camera."""
    entries = [
        {
            "name": NAMES[k],
            "model": model(settings, k),
            "T_lidar_camera": T.tolist(),
            "source": "simulated",
            "clock_offset_s": settings.camera_clock_s,
            "readout_s": settings.readout_s,
        }
        for k, T in enumerate(poses)
    ]
    return Cameras(cameras=tuple(Camera.model_validate(entry) for entry in entries))
