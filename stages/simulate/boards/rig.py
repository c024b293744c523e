"""The rig before the board: three cameras with different lenses about the LiDAR, none of them quite where it belongs."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.cameras import Camera, CameraModel, Lens
from scanloom.stages.geometry.se3 import F8, pose, se3_exp, so3_exp
from scanloom.stages.simulate.boards.settings import BoardSettings

NAMES = ("front", "left", "right")
_HEADING_DEG = (0.0, 50.0, -50.0)
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (right, down, forward) of a camera that looks along the LiDAR's x, as columns in the LiDAR's frame."""

_LENSES: tuple[tuple[Lens, float, float, tuple[float, ...]], ...] = (
    ("radial-tangential", 0.56, 1.002, (-0.21, 0.06, 4e-4, -3e-4)),
    ("equidistant", 0.475, 0.999, (-0.012, 0.004, -0.002, 3e-4)),
    ("radial-tangential", 0.6, 1.002, (-0.1, 0.09, -2e-4, 5e-4)),
)
"""Kind, focal length as a share of the width, of its height to it, distortion."""


def lens(number: int, width_px: int, height_px: int) -> CameraModel:
    """A wide one, a fisheye, and a wide one with another bend; focal lengths go with the width."""
    kind, focal, ratio, bend = _LENSES[number]
    return CameraModel(
        lens=kind,
        width_px=width_px,
        height_px=height_px,
        fx_px=focal * width_px,
        fy_px=ratio * focal * width_px,
        cx_px=0.502 * width_px - 0.5,
        cy_px=0.496 * height_px - 0.5,
        distortion=bend,
    )


def true_cameras(settings: BoardSettings, rng: np.random.Generator) -> tuple[Camera, ...]:
    """The cameras as they are."""
    cameras = []
    for k in range(settings.cameras):
        turn = so3_exp((0.0, 0.0, np.radians(_HEADING_DEG[k])))
        ideal = pose(turn @ _AXES, turn @ (0.2, 0.0, -0.15))
        off = np.concatenate(
            (
                np.radians(settings.mount_deg) * rng.standard_normal(3),
                settings.mount_m * rng.standard_normal(3),
            )
        )
        model = lens(k, settings.width_px, settings.height_px)
        cameras.append(camera_of(NAMES[k], model, ideal @ se3_exp(off)))
    return tuple(cameras)


def camera_of(name: str, model: CameraModel, T_lidar_camera: F8) -> Camera:
    """A camera with its place."""
    return Camera.model_validate(
        {"name": name, "model": model, "T_lidar_camera": T_lidar_camera.tolist(), "source": "simulated"}
    )


def told_camera(camera: Camera, settings: BoardSettings, rng: np.random.Generator) -> Camera:
    """What the user has of it: a focal length that is a little off, and no place."""
    factor = 1.0 + settings.focal_error * float(rng.standard_normal())
    m = camera.model
    model = m.model_copy(update={"fx_px": m.fx_px * factor, "fy_px": m.fy_px * factor})
    return Camera(name=camera.name, model=model, source="camera info")
