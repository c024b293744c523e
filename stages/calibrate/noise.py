"""What the calibration believes of its sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanloom.stages.geometry.se3 import F8


@dataclass(frozen=True)
class Noise:
    """What the factors weigh; the noise of a cloud's points comes with its board."""

    corner_least_px: float = 0.1
    """Corners are never believed better than this."""
    bias: tuple[float, float, float, float] = (1e-3, 1e-3, 5e-4, 5e-4)
    """What a whole board is off in the cloud beyond the noise of its points: tilt and turn about the normal, rad, on its
    plane and along its normal, m."""
    range_offset_m: float = 0.01
    """By how much the LiDAR may read all ranges too long; 0 believes them as they are."""
    softness: float = 3.0
    """Corners beyond so many standard deviations count linearly (Huber)."""
    lens_share: float = 0.0
    """Standard deviation of focal lengths and centre as a share of the focal length; 0 keeps them as given."""

    @property
    def bias_sigmas(self) -> F8:
        """(6,) in the order of a tangent of the board."""
        tilt, spin, plane, normal = self.bias
        return np.array([tilt, tilt, spin, plane, plane, normal])

    @property
    def bias_covariance(self) -> F8:
        return np.diag(self.bias_sigmas**2)

    @property
    def range_prior_m(self) -> float:
        """Never quite zero, so that the variable can stay in the graph."""
        return max(self.range_offset_m, 1e-6)

    def with_bias(self, tilt: float, spin: float, plane: float, normal: float) -> Noise:
        """With the larger of this and the least bias."""
        least = self.bias
        return replace(
            self,
            bias=(max(tilt, least[0]), max(spin, least[1]), max(plane, least[2]), max(normal, least[3])),
        )
