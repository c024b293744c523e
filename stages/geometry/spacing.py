"""How far apart a sensor's returns are, from their number."""

from __future__ import annotations

import numpy as np

USUAL_BEAMS = 32
FINEST_STEP_RAD, COARSEST_STEP_RAD = 0.001, 0.02


def azimuth_step_rad(points: int, beams: int) -> float:
    """Angle between neighbouring points of a beam, from their number; too wide, not too narrow, if many are missing.

    beams : of the sensor, 0 when unknown.
    """
    step = 2 * np.pi * (beams or USUAL_BEAMS) / max(points, 1)
    return float(np.clip(step, FINEST_STEP_RAD, COARSEST_STEP_RAD))
