"""Three real handheld sweeps (Newer College) and the points that another tool made of them.

Neither an IMU nor neighbouring scans came with them. So the motion is read from the published points, twelve numbers a
sweep from every 20th point, and given to our deskew as what a gyro and a wheel would have said. What is compared, on the
other points, is all that deskew does with a motion: stamps, interpolation, lever arms, the frame and time referred to.
That the motion itself is right cannot be told from these files (docs/odometry.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanloom.schemas.scans import Scan, Scans
from scanloom.schemas.session import Extrinsic, Matrix4, Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.deskew import Settings, deskew
from scanloom.stages.geometry.se3 import F8, hat, pose, so3_exp, so3_log

SCANS = 3
START_NS = 1_700_000_000_000_000_000
T_IMU_LIDAR = pose(np.diag([-1.0, -1.0, 1.0]), np.array([-0.006, 0.012, -0.029]))
"""The published points are in the IMU's frame at the start of the sweep: this is how those of time zero were moved."""
SWEEP_S, SAMPLES = 0.1, 10
EVERY = 20
"""The motion is read from every 20th point; the others are compared."""
STEPS, ROBUST_M = 20, 0.03


@dataclass(frozen=True)
class Sweep:
    """A scan whose reference is the start of its sweep, and its published points (n, 3) in the LiDAR's frame then, m."""

    scan: Scan
    published: F8

    @property
    def seconds(self) -> F8:
        """Time (n,) of each point since the start, s."""
        return (self.scan.stamp_ns - START_NS) * 1e-9


@dataclass(frozen=True)
class Motion:
    """Pose of the LiDAR in its frame at the start, with constant accelerations: twelve numbers.

    Rotation vector and position, rad and m, are a u + b u^2 with u = t / SWEEP_S and the rows a, b (2, 6) of `found`.
    """

    found: F8

    def sensors(self, *, walking: bool) -> tuple[Imu, Wheel, tuple[Extrinsic, ...]]:
        """What a gyro and, if `walking`, a wheel rolling along the mean way would have said, and how they are mounted."""
        share = np.arange(SAMPLES + 1) / SAMPLES
        knots = np.column_stack((share, share**2)) @ self.found
        step_s, R = SWEEP_S / SAMPLES, so3_exp(knots[:, :3])
        stamp_ns = START_NS + np.round((np.arange(SAMPLES) + 0.5) * step_s * 1e9).astype(np.int64)
        turns = so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
        middle = R[:-1] @ so3_exp(0.5 * turns)
        velocity = np.einsum("kji,kj->ki", middle, np.diff(knots[:, 3:], axis=0)) / step_s
        T_base_lidar = pose(_facing(velocity.mean(axis=0)), np.zeros(3))
        mounted: Matrix4 = tuple(tuple(row) for row in T_base_lidar.tolist())  # type: ignore[assignment]
        where = (
            Extrinsic(sensor="lidar", T_base_sensor=mounted, source="published points"),
            Extrinsic(sensor="imu", T_base_sensor=mounted, source="published points"),
        )
        imu = Imu(stamp_ns, turns / step_s, np.full((SAMPLES, 3), np.nan))
        speed, unknown = velocity @ T_base_lidar[0, :3], np.full(SAMPLES, np.nan)
        return imu, Wheel(stamp_ns, speed, unknown) if walking else Wheel.empty(), where


def load(folder: Path, i: int) -> Sweep:
    """Scan i of the folder."""
    raw, published = (
        np.fromfile(folder / f"{name}_{i:02d}.bin", np.float32).reshape(-1, 3) for name in ("raw", "deskewed")
    )
    seconds = np.fromfile(folder / f"times_{i:02d}.bin", np.float32).astype(np.float64)
    x, y, z = np.ascontiguousarray(raw.T)
    n = len(raw)
    scan = Scan(
        stamp_ns=START_NS + np.round(seconds * 1e9).astype(np.int64), x_m=x, y_m=y, z_m=z,
        intensity=np.zeros(n, np.float32), ring=np.zeros(n, np.uint16), return_no=np.zeros(n, np.uint8),
        reference_ns=START_NS, scan_index=i,
    )  # fmt: skip
    return Sweep(scan, (published.astype(np.float64) - T_IMU_LIDAR[:3, 3]) @ T_IMU_LIDAR[:3, :3])


def published_motion(sweep: Sweep) -> Motion:
    """The motion that the other tool had, by least squares over every EVERY-th point (Gauss-Newton).

    Residual Exp(w(t)) p + m(t) - q, robust (Geman and McClure): the tool held the motion for the last milliseconds of a
    sweep, after its last IMU sample, which at 45 m puts its points up to 0.4 m off to the side.
    """
    raw, wanted = sweep.scan.points()[::EVERY].astype(np.float64), sweep.published[::EVERY]
    share = sweep.seconds[::EVERY] / SWEEP_S
    powers = np.column_stack((share, share**2))
    found = np.zeros((2, 6))
    for _ in range(STEPS):
        tangent = powers @ found
        turned = np.einsum("nij,nj->ni", so3_exp(tangent[:, :3]), raw)
        off = turned + tangent[:, 3:] - wanted
        weight = 1 / (1 + (off**2).sum(axis=1) / ROBUST_M**2)
        J = np.concatenate((-hat(turned), np.broadcast_to(np.eye(3), (len(raw), 3, 3))), axis=2)
        J = (powers[:, None, :, None] * J[:, :, None, :]).reshape(len(raw), 3, -1)
        H, b = np.einsum("nij,n,nik->jk", J, weight, J), np.einsum("nij,n,ni->j", J, weight, off)
        found = found - np.linalg.solve(H, b).reshape(2, 6)
    return Motion(found)


def deskewed(sweep: Sweep, *, walking: bool, motion: Motion | None = None) -> F8:
    """Points (n, 3) that our deskew makes of the scan at its reference time, m; `motion` as published unless given."""
    imu, wheel, extrinsics = (motion or published_motion(sweep)).sensors(walking=walking)
    (flat,) = deskew(Settings(), Scans([sweep.scan]), _session(extrinsics), imu, wheel)
    return flat.points().astype(np.float64)


def range_differences(sweep: Sweep, points: F8) -> F8:
    """|range of our point - range of the published one|, m, of the points that the motion was not read from."""
    others = np.arange(len(points)) % EVERY != 0
    ours, theirs = np.linalg.norm(points, axis=1), np.linalg.norm(sweep.published, axis=1)
    difference: F8 = np.abs(ours - theirs)[others]
    return difference


def _facing(direction: F8) -> F8:
    """Rotation (3, 3) that brings a direction onto x, turning as little as possible."""
    unit = direction / np.linalg.norm(direction)
    axis = np.cross(unit, [1.0, 0.0, 0.0])
    size = float(np.linalg.norm(axis))
    angle = np.arctan2(size, unit[0])
    return so3_exp(axis / size * angle) if size > 1e-9 else np.eye(3)


def _session(extrinsics: tuple[Extrinsic, ...]) -> Session:
    return Session(
        name="handheld", format="point files", start_ns=START_NS, end_ns=START_NS + 10**9, scan_count=1,
        point_count=25_000, scan_rate_hz=10.0, beams=64, point_time="per point", topics=(), extrinsics=extrinsics,
        problems=(), complete=True,
    )  # fmt: skip
