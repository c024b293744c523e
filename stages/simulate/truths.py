"""Truth beside poses and points, as tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanloom.schemas.simulated import TrueFixes, TrueObjects
from scanloom.stages.simulate.gnss import NO_FIX, GnssTrack
from scanloom.stages.simulate.town import Thing


def true_fixes(start_s: int, track: GnssTrack) -> TrueFixes:
    """Where the antenna was at each message, and what was made of it."""
    return TrueFixes(
        stamp_ns=track.stamp_ns,
        true_ns=start_s * 1_000_000_000 + np.round(track.t * 1e9).astype(np.int64),
        antenna_m=track.antenna_m,
        error_m=np.where((track.status == NO_FIX)[:, None], np.nan, track.error_m),
        lie=track.lie,
    )


def true_objects(things: Sequence[Thing]) -> TrueObjects:
    """Boxes of what stands about, in the order of their numbers."""
    centre = np.array([thing.centre for thing in things], float).reshape(-1, 3)
    size = np.array([thing.size_m for thing in things], float).reshape(-1, 3)
    return TrueObjects(
        instance=np.arange(1, len(things) + 1, dtype=np.uint16),
        what=np.array([thing.what for thing in things], object),
        x_m=centre[:, 0],
        y_m=centre[:, 1],
        z_m=centre[:, 2],
        yaw_rad=np.array([thing.yaw_rad for thing in things], float),
        length_m=size[:, 0],
        width_m=size[:, 1],
        height_m=size[:, 2],
    )
