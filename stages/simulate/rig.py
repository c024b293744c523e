"""Where the sensors sit on the vehicle, and the vehicle itself as its LiDAR sees it."""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8, pose
from scanloom.stages.simulate.meshes import Material, Mesh, box, cylinder, joined
from scanloom.stages.simulate.motion import rotations

MIN_RANGE_M = 0.4
"""Nearer returns the LiDAR does not report."""
WEAKEST = 1.2e-5
"""Received power, reflectivity over range squared, of which half the returns are lost."""


def mount(xyz: tuple[float, float, float], rpy_deg: tuple[float, float, float]) -> F8:
    """Pose (4, 4) at a place in metres, turned by roll, pitch and yaw in degrees."""
    roll, pitch, yaw = (np.radians([angle]) for angle in rpy_deg)
    return pose(rotations(roll, pitch, yaw)[0], xyz)


T_BASE = {
    "lidar": mount((1.05, 0.03, 1.92), (0.7, 1.6, -1.1)),
    "imu": mount((0.35, -0.28, 0.55), (0.4, -0.6, 1.5)),
    "gnss": mount((-0.55, 0.35, 1.75), (0.0, 0.0, 0.0)),
}
"""Pose of each sensor in the base frame: on the ground below the rear axle, x forward."""


def vehicle() -> Mesh:
    """Bonnet, roof, mast of the LiDAR and mount of the antenna, in the base frame."""
    return joined(
        [
            box([-1.0, -0.75, 1.1], [1.95, 0.75, 1.48], Material.PAINT_LIGHT, 0.93),
            box([-0.9, -0.9, 0.3], [3.6, 0.9, 0.98], Material.PAINT_LIGHT, 0.97),
            cylinder([-0.55, 0.35, 1.4], [-0.55, 0.35, 1.74], 0.05, Material.PAINT_DARK),
            box([-0.2, -0.6, 1.5], [-0.1, 0.6, 1.62], Material.METAL),
        ]
    )
