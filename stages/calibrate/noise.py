"""What the calibration believes of its sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanloom.stages.calibrate.cloud.misfit import SENSOR_SIGMA_M
from scanloom.stages.geometry.se3 import F8


@dataclass(frozen=True)
class Noise:
    """What the factors weigh; the noise of a cloud's points comes with its board."""

    corner_least_px: float = 0.1
    """Corners are never believed better than this."""
    bias: tuple[float, float, float, float] = (1e-3, 1e-3, 5e-4, 5e-4)
    """What a whole board is off in the cloud beyond the noise of its points: tilt and turn about the normal, rad, on its
    plane and along its normal, m."""
    beam_m: float = 0.003
    """By how much a beam's offset changes from placement to placement."""
    beam_offset_m: float = 0.01
    """By how much each beam's ranges may differ from the others'."""
    sensor_m: tuple[float, ...] = tuple(float(v) for v in SENSOR_SIGMA_M)
    """How far off the sensor may be in what all its clouds share, in the order of `SENSOR`."""
    softness: float = 3.0
    """Corners beyond so many standard deviations count linearly (Huber)."""
    lens_share: float = 0.0
    """Standard deviation of focal lengths and centre as a share of the focal length; 0 keeps them as given."""
    lens_bend_px: float = 0.0
    """How far each coefficient of the lens may be off, by what it does at a corner of the image; 0 keeps them as given."""

    @property
    def lens_free(self) -> bool:
        """Whether intrinsics are estimated along."""
        return self.lens_share > 0 or self.lens_bend_px > 0

    @property
    def bias_sigmas(self) -> F8:
        """(6,) in the order of a tangent of the board."""
        tilt, spin, plane, normal = self.bias
        return np.array([tilt, tilt, spin, plane, plane, normal])

    def believing(self) -> Noise:
        """The same with a LiDAR that is off in nothing, as most tools take it."""
        return replace(self, beam_offset_m=0.0, sensor_m=(0.0,) * len(self.sensor_m))

    def with_bias(self, bias: tuple[float, float, float, float], beam_m: float) -> Noise:
        """With the larger of these and the least ones of the defaults."""
        least = Noise()
        tilt, spin, plane, normal = (max(value, floor) for value, floor in zip(bias, least.bias))
        return replace(self, bias=(tilt, spin, plane, normal), beam_m=max(beam_m, _LEAST_BEAM_M))


_LEAST_BEAM_M = 5e-4
