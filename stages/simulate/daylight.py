"""Daylight: a sun that casts shadows and a sky that lights the rest; level ground in the open gets 1."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.settings import Settings

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]

_LIFT_M = 0.02
"""Above its surface a point cannot shade itself."""
_UNDER_ROOF = 0.3
"""Of the sky's light under something."""
_BOUNCED = 0.18
"""Of the light on the ground comes back from it."""
_SUN_DEG, _HALO_DEG = 0.8, 7.0
_HAZE_M = 1200.0
_ZENITH, _HORIZON = np.array([0.32, 0.52, 0.95], np.float32), np.array([0.85, 0.92, 1.0], np.float32)
_WARM = np.array([1.03, 1.0, 0.94], np.float32)
_COOL = np.array([0.97, 1.0, 1.06], np.float32)


class Daylight:
    """The light over one town."""

    def __init__(self, settings: Settings, scene: Any) -> None:
        high, round_ = np.radians(settings.sun_elevation_deg), np.radians(settings.sun_azimuth_deg)
        self.towards_sun = np.array(
            [np.cos(high) * np.sin(round_), np.cos(high) * np.cos(round_), np.sin(high)]
        )
        self._sun = settings.sun_share / float(np.sin(high))
        self._sky = 1.0 - settings.sun_share
        self._scene = scene

    def lit(self, points: F8) -> B1:
        """Whether the sun sees points (n, 3) of the world that lie just before their surfaces; moving things cast no
        shadow."""
        return self._open(points, self.towards_sun)

    def under_sky(self, points: F8, normals: F8) -> B1:
        """Whether nothing is above points (n, 3) of the world."""
        return self._open(points + _LIFT_M * normals, np.array([0.0, 0.0, 1.0]))

    def falling(self, points: F8, normals: F8, open_up: B1) -> tuple[F4, B1]:
        """Light (n, 3), red green blue, on surfaces at points (n, 3) of the world, of which some have nothing above
        them, and where the sun shines."""
        before = points + _LIFT_M * normals
        facing = normals @ self.towards_sun
        lit = facing > 0.0
        lit[lit] = self._open(before[lit], self.towards_sun)
        sky = self._sky * np.where(open_up, 1.0, _UNDER_ROOF)
        level = (0.5 + 0.5 * normals[:, 2]).astype(np.float32)
        from_sky = (sky * level + _BOUNCED * (1.0 - level) * np.where(open_up, 1.0, _UNDER_ROOF)).astype(
            np.float32
        )
        from_sun = (self._sun * np.where(lit, facing, 0.0)).astype(np.float32)
        return from_sky[:, None] * _COOL + from_sun[:, None] * _WARM, lit

    def sky(self, directions: F8) -> F4:
        """Radiance (n, 3) of the sky, with the sun in it and clouds."""
        up = np.clip(directions[:, 2], 0.0, 1.0).astype(np.float32)
        blue = _HORIZON + (_ZENITH - _HORIZON) * np.sqrt(up)[:, None]
        far = directions[:, :2] / (directions[:, 2:] + 0.15)
        cloudy = np.sin(1.7 * far[:, 0] + np.sin(2.9 * far[:, 1])) + np.sin(3.1 * far[:, 1] + 1.3 * far[:, 0])
        white = np.clip(0.5 * cloudy, 0.0, 0.8).astype(np.float32)[:, None]
        radiance = blue * (1 - white) + np.float32(1.15) * white
        return np.asarray(radiance + self.glow(directions)[:, None], np.float32)

    def glow(self, directions: F8) -> F4:
        """The sun and its halo."""
        away = np.degrees(np.arccos(np.clip(directions @ self.towards_sun, -1.0, 1.0)))
        return np.asarray(
            self._sun * (120.0 * (away < _SUN_DEG) + 1.2 * np.exp(-away / _HALO_DEG)), np.float32
        )

    def hazed(self, radiance: F4, range_m: F8) -> F4:
        """What is left of radiance (n, 3) after so many metres of air."""
        clear = np.exp(-range_m / _HAZE_M).astype(np.float32)[:, None]
        return np.asarray(radiance * clear + np.float32(0.8) * _HORIZON * (1 - clear), np.float32)

    def _open(self, points: F8, towards: F8) -> B1:
        import open3d as o3d

        if len(points) == 0:
            return np.zeros(0, bool)
        tensor: Any = o3d.core.Tensor  # its stubs know nothing of numpy
        lines = np.empty((len(points), 6), np.float32)
        lines[:, :3], lines[:, 3:] = points, towards
        return np.asarray(~self._scene.test_occlusions(tensor(lines)).numpy())
