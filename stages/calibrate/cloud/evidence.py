"""All a cloud says about one board as one small linear system, for a graph that couples many of them.

Errors that belong to the sensor are the same in every cloud: how far each beam's ranges are off, how much farther dark
print reads than bright print, by how much boards look larger, where the beams cross, how far
all ranges are off. One cloud alone cannot tell the beams' errors from a tilt
of the board; many clouds together, with cameras, can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.calibrate.cloud.sweep import I8
from scanloom.stages.geometry.se3 import F8

SENSOR = ("flare_m", "darker_m", "crossing_m", "farther_m")
"""Unknowns of the sensor that come first; then one error of range for each beam."""


@dataclass(frozen=True)
class Evidence:
    """|root (xi, sensor) + gap|^2 is twice the cost of the cloud near `T_lidar_board`, without any prior.

    xi is the right tangent (rotation, translation) from `T_lidar_board`; sensor is (flare, darker, crossing, farther, beams' errors), m.
    """

    T_lidar_board: F8
    beams: I8
    """(k,) numbers of the beams: rings as the sensor counts them, or elevations in tenths of a degree."""
    root: F8
    """(p, 6 + 4 + k) upper triangular."""
    gap: F8
    """(p,)."""


def evidence_of(T_lidar_board: F8, beams: I8, slopes: F8, errors: F8) -> Evidence:
    """From whitened errors (n,) and their derivatives (n, 10 + k) at a pose and zero errors of the sensor."""
    triangle = np.asarray(np.linalg.qr(np.column_stack((slopes, errors)), mode="r"), np.float64)
    width = slopes.shape[1]
    return Evidence(T_lidar_board, beams, triangle[:width, :width], triangle[:width, width])
