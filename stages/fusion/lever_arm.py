"""Where the GNSS antenna stands on the vehicle, when the log does not tell."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.session import Extrinsic, Session
from scanloom.stages.fusion.calibration import Calibration
from scanloom.stages.geometry.se3 import F8

CLEAR_SQUARE = 30.0
"""Five standard deviations and some: errors of GNSS last, and look like an antenna for a while."""
LARGEST_SIGMA_M = 0.3
ASSUMED = "assumed identity"


def told(session: Session) -> bool:
    """The log says where the antenna is."""
    return any(e.sensor == "gnss" and e.source != ASSUMED for e in session.extrinsics)


def clear(found: Calibration) -> bool:
    """The antenna is known well enough, and further from where it was assumed than fixes scatter."""
    shift, C = found.value[1:3], found.covariance[1:3, 1:3]
    sure = found.sigma[1:3].max() < LARGEST_SIGMA_M and shift @ np.linalg.solve(C, shift) > CLEAR_SQUARE
    return bool(sure and np.linalg.norm(shift) > found.rms_m)


def with_antenna(session: Session, shift_m: F8) -> Session:
    """The session with its antenna (3,) further forward, left and up than it says."""
    T = np.array(session.T_base("gnss"))
    T[:3, 3] += shift_m
    rows = tuple(tuple(float(v) for v in row) for row in T)
    moved = Extrinsic(sensor="gnss", T_base_sensor=rows, source="motion")  # type: ignore[arg-type]
    others = tuple(e for e in session.extrinsics if e.sensor != "gnss")
    return session.model_copy(update={"extrinsics": (*others, moved)})


def said(found: Calibration, shift_m: F8) -> str:
    """What was found about the antenna, in words; forward and left of where it was assumed."""
    words = [
        f"{abs(value):.2f} m {ahead if value > 0 else behind}"
        for value, ahead, behind in zip(
            shift_m, ("ahead of", "left of"), ("behind", "right of"), strict=False
        )
    ]
    sigma = found.sigma[1:3].max()
    return f"GNSS antenna found {words[0]} and {words[1]} the place assumed (sd {sigma:.2f} m)"


UNKNOWN = "the log does not say where the GNSS antenna stands, and the motion does not tell; taken to be at the base"
