"""Truth beside poses and points, as tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.simulated import TrueFixes, TrueObjects, TrueTracks
from scanloom.stages.simulate.gnss import NO_FIX, GnssTrack
from scanloom.stages.simulate.route import Path
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.town import Thing
from scanloom.stages.simulate.traffic import Mover

SPEED_S = 0.05
"""Speed is taken over twice this time, s."""


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


def true_tracks(
    settings: Settings, path: Path, movers: Sequence[Mover], stands: int, seen: Sequence[NDArray[np.uint16]]
) -> TrueTracks:
    """Boxes of everything that moves, scan by scan. `stands` is how many numbers objects that stand about have, `seen`
    the true instances of the points of every scan."""
    s = settings
    t = (np.arange(len(seen)) + (s.columns // 2) / s.columns) / s.rate_hz
    numbers = stands + 1 + np.arange(len(movers))
    tracks = [_track(mover, path, t) for mover in movers]
    points = [np.bincount(instance, minlength=65536)[numbers] for instance in seen]
    boxes = np.stack(tracks, axis=1).reshape(-1, 8) if tracks else np.empty((0, 8))
    there = (
        np.stack([mover.present(t) for mover in movers], axis=1) if movers else np.empty((len(t), 0), bool)
    )
    rows = TrueTracks(
        scan_index=np.repeat(np.arange(len(seen)), len(movers)),
        instance=np.tile(numbers, len(seen)).astype(np.uint16),
        what=np.array([mover.what for mover in movers] * len(seen), object),
        class_=np.array([mover.kind(float(time)) for time in t for mover in movers], np.uint8),
        points=np.array(points, np.uint32).reshape(-1),
        x_m=boxes[:, 0],
        y_m=boxes[:, 1],
        z_m=boxes[:, 2],
        yaw_rad=boxes[:, 3],
        length_m=boxes[:, 4],
        width_m=boxes[:, 5],
        height_m=boxes[:, 6],
        speed_m_s=boxes[:, 7],
    )
    return rows.take(there.reshape(-1))


def _track(mover: Mover, path: Path, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Middle x, y, z, yaw, length, width, height and speed (n, 8) of one mover at times t."""
    low, high = mover.mesh.vertices.min(axis=0), mover.mesh.vertices.max(axis=0)
    low[2] = 0.0
    T = mover.poses(path, t)
    middle = T[:, :3, :3] @ ((low + high) / 2) + T[:, :3, 3]
    step = mover.poses(path, t + SPEED_S)[:, :3, 3] - mover.poses(path, t - SPEED_S)[:, :3, 3]
    speed = np.linalg.norm(step, axis=1) / (2 * SPEED_S)
    yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    return np.column_stack((middle, yaw, np.tile(high - low, (len(t), 1)), speed))
