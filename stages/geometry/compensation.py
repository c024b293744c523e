"""Points measured while the LiDAR moved, expressed in its frame at one time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.motion import MotionTrack, Twists
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
I8 = NDArray[np.int64]

KNOTS = 64
"""Poses across a sweep. Between two of them matrices are interpolated linearly: at 500 deg/s and 100 m off by 2 mm."""
LONGEST_SWEEP_NS = 500_000_000
"""Points farther from the reference time than this have a wrong stamp and are treated as if measured at this limit."""


def compensate(
    stamp_ns: I8,
    x_m: F4,
    y_m: F4,
    z_m: F4,
    reference_ns: int,
    track: MotionTrack,
    twist: F8 | Twists | None = None,
) -> tuple[F4, F4, F4]:
    """Coordinates (n,) each, m, in the LiDAR frame at `reference_ns`: p' = T_reference_t p (methods 1.4).

    track, twist : the motion, see `MotionTrack.poses`. Without motion, or when all stamps are equal, the very arrays
        that came in are returned.
    """
    if len(stamp_ns) == 0:
        return x_m, y_m, z_m
    span = np.clip(
        (stamp_ns.min(), stamp_ns.max()), reference_ns - LONGEST_SWEEP_NS, reference_ns + LONGEST_SWEEP_NS
    )
    first, last = int(span[0]), int(span[1])
    if first == last:
        return x_m, y_m, z_m
    step_ns = (last - first) / KNOTS
    knot_ns = first + np.round(step_ns * np.arange(KNOTS + 1)).astype(np.int64)
    moved = np.ascontiguousarray(track.poses(knot_ns, reference_ns, twist)[:, :3] - np.eye(4)[:3])
    if not moved.any():
        return x_m, y_m, z_m
    return _displace(stamp_ns, x_m, y_m, z_m, first, 1.0 / step_ns, moved)


@kernel
def _displace(
    stamp_ns: I8, x: F4, y: F4, z: F4, first_ns: int, per_ns: float, moved: F8
) -> tuple[F4, F4, F4]:
    """p + D(t) p with D = T_reference_t - 1, (KNOTS + 1, 3, 4), interpolated linearly in time."""
    n = len(stamp_ns)
    out_x, out_y, out_z = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    last = len(moved) - 1
    for i in range(n):
        place = min(max((stamp_ns[i] - first_ns) * per_ns, 0.0), float(last))
        k = min(int(place), last - 1)
        b = place - k
        px, py, pz = float(x[i]), float(y[i]), float(z[i])
        out_x[i] = px + _shift(moved, k, 0, b, px, py, pz)
        out_y[i] = py + _shift(moved, k, 1, b, px, py, pz)
        out_z[i] = pz + _shift(moved, k, 2, b, px, py, pz)
    return out_x, out_y, out_z


@kernel
def _shift(moved: F8, k: int, r: int, b: float, px: float, py: float, pz: float) -> float:
    """Row r of D p, the share b of the way from knot k to the next."""
    before = moved[k, r, 0] * px + moved[k, r, 1] * py + moved[k, r, 2] * pz + moved[k, r, 3]
    after = moved[k + 1, r, 0] * px + moved[k + 1, r, 1] * py + moved[k + 1, r, 2] * pz + moved[k + 1, r, 3]
    shift: float = (1.0 - b) * before + b * after
    return shift
