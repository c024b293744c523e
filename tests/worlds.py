"""A small analytic world for unit tests: boxes and a ground plane, seen by a spinning LiDAR with exact truth.

Smaller and simpler than the simulator's town, and independent of it, so that neither hides an error of the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import DeskewedScan, Scan
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, so3_exp

GROUND_Z_M = -1.8


@dataclass(frozen=True)
class BoxWorld:
    """Axis-aligned boxes (n, 2, 3) of lower and upper corners, m, over a ground plane at GROUND_Z_M."""

    boxes: F8

    def ranges(self, origin: F8, direction: F8, far_m: float = 100.0) -> F8:
        """Distance (n,) along rays from `origin` (n, 3) with unit `direction` (n, 3); inf where nothing is hit."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (GROUND_Z_M - origin[:, 2]) / direction[:, 2]
            best = np.where(t > 0, t, np.inf)
            for low, high in self.boxes:
                a, b = (low - origin) / direction, (high - origin) / direction
                near, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
                hit = (near <= leave) & (near > 0)
                best = np.where(hit & (near < best), near, best)
        return np.where(best < far_m, best, np.inf)


def street(seed: int = 0, length_m: float = 120.0) -> BoxWorld:
    """Two rows of houses of varied depth with gaps, poles and parked cars."""
    rng = np.random.default_rng(seed)
    boxes = []
    for side in (-1.0, 1.0):
        x = -40.0
        while x < length_m + 40:
            width, depth, setback = rng.uniform(6, 14), rng.uniform(6, 10), rng.uniform(7, 12)
            y = sorted((side * setback, side * (setback + depth)))
            boxes.append([[x, y[0], GROUND_Z_M], [x + width, y[1], rng.uniform(3, 9)]])
            x += width + rng.uniform(1, 6)
        for pole in np.arange(-40, length_m + 40, 17.0) + rng.uniform(0, 5):
            boxes.append([[pole, side * 5 - 0.1, GROUND_Z_M], [pole + 0.2, side * 5 + 0.1, 5.0]])
        for car in rng.uniform(-40, length_m + 40, 12):
            boxes.append([[car, side * 4 - 0.9, GROUND_Z_M], [car + 4.3, side * 4 + 0.9, GROUND_Z_M + 1.5]])
    return BoxWorld(np.array(boxes))


def beams(rows: int = 16, columns: int = 512, low_deg: float = -20.0, high_deg: float = 10.0) -> F8:
    """Unit directions (columns * rows, 3), column by column, turning clockwise as most sensors do."""
    azimuth = -np.linspace(0, 2 * np.pi, columns, endpoint=False) + np.pi
    elevation = np.radians(np.linspace(low_deg, high_deg, rows))
    a, e = np.repeat(azimuth, rows), np.tile(elevation, columns)
    return np.column_stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))


def observe(
    world: BoxWorld, T_world_lidar: F8, *, index: int = 0, stamp_ns: int = 0, rng: np.random.Generator | None = None,
    noise_m: float = 0.02, rows: int = 16, columns: int = 512,
) -> DeskewedScan:  # fmt: skip
    """One ideal (not moving) sweep from a pose, with range noise."""
    rays = beams(rows, columns)
    origin = np.broadcast_to(T_world_lidar[:3, 3], rays.shape)
    ranges = world.ranges(origin, rays @ T_world_lidar[:3, :3].T)
    if rng is not None:
        ranges = ranges + rng.normal(0, noise_m, len(ranges))
    return at_once(_scan(rays, ranges, np.arange(len(rays)) // rows, rows, columns, stamp_ns, index))


def sweep(
    world: BoxWorld, T_world_lidar: F8, twist: F8, *, index: int = 0, stamp_ns: int = 0, period_s: float = 0.1,
    rng: np.random.Generator | None = None, noise_m: float = 0.02, rows: int = 16, columns: int = 512,
) -> Scan:  # fmt: skip
    """One sweep taken while moving: pose at mid-sweep, constant body `twist` (6,) = (rad/s, m/s)."""
    rays = beams(rows, columns)
    column = np.arange(len(rays)) // rows
    dt = (column / columns - 0.5) * period_s
    T = T_world_lidar @ se3_exp(dt[:, None] * twist)
    ranges = world.ranges(T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], rays))
    if rng is not None:
        ranges = ranges + rng.normal(0, noise_m, len(ranges))
    return _scan(rays, ranges, column, rows, columns, stamp_ns, index, period_s)


def sweep_along(
    world: BoxWorld, path: Callable[[F8], F8], middle_s: float, *, index: int = 0, stamp_ns: int = 0,
    period_s: float = 0.1, rng: np.random.Generator | None = None, noise_m: float = 0.02, rows: int = 16,
    columns: int = 512,
) -> Scan:  # fmt: skip
    """One sweep around the time `middle_s`, taken along a `path` that gives poses (n, 4, 4) at times (n,), s."""
    rays = beams(rows, columns)
    column = np.arange(len(rays)) // rows
    T = np.repeat(path(middle_s + (np.arange(columns) / columns - 0.5) * period_s), rows, axis=0)
    ranges = world.ranges(T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], rays))
    if rng is not None:
        ranges = ranges + rng.normal(0, noise_m, len(ranges))
    return _scan(rays, ranges, column, rows, columns, stamp_ns, index, period_s)


def at_once(scan: Scan) -> DeskewedScan:
    """The scan as if the LiDAR had stood still, or of a LiDAR that did."""
    return DeskewedScan(
        x_m=scan.x_m, y_m=scan.y_m, z_m=scan.z_m, intensity=scan.intensity, reference_ns=scan.reference_ns,
        scan_index=scan.scan_index,
    )  # fmt: skip


def _scan(
    rays: F8, ranges: F8, column: NDArray[np.int64], rows: int, columns: int, stamp_ns: int, index: int,
    period_s: float = 0.1,
) -> Scan:  # fmt: skip
    hit = np.isfinite(ranges)
    xyz = (rays * np.where(hit, ranges, 0)[:, None])[hit].astype(np.float32)
    dt = (column[hit] / columns - 0.5) * period_s * 1e9
    ring = np.tile(np.arange(rows), columns)[hit].astype(np.uint16)
    return Scan(
        stamp_ns=stamp_ns + dt.astype(np.int64),
        x_m=xyz[:, 0].copy(), y_m=xyz[:, 1].copy(), z_m=xyz[:, 2].copy(),
        intensity=np.full(len(xyz), 0.3, np.float32), ring=ring, return_no=np.zeros(len(xyz), np.uint8),
        reference_ns=stamp_ns, scan_index=index,
    )  # fmt: skip


def drive(
    world: BoxWorld, count: int, *, step_m: float = 1.0, yaw_step_rad: float = 0.0, seed: int = 0,
    rows: int = 16, columns: int = 512, noise_m: float = 0.02,
) -> tuple[list[DeskewedScan], F8]:  # fmt: skip
    """Scans along an arc at 10 Hz and their true poses (count, 4, 4); the first pose is identity."""
    rng = np.random.default_rng(seed)
    step = pose(so3_exp([0, 0, yaw_step_rad]), [step_m, 0, 0])
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    scans = [
        observe(world, T, index=i, stamp_ns=i * 100_000_000 + 1_700_000_000_000_000_000, rng=rng,
                noise_m=noise_m, rows=rows, columns=columns)
        for i, T in enumerate(poses)
    ]  # fmt: skip
    return scans, np.array(poses)


def relative(T_a: F8, T_b: F8) -> F8:
    """T_a^-1 T_b."""
    return inverse(T_a) @ T_b
