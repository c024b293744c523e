"""Small drives through box worlds for tests of places and loops: scans, labels, odometry from truth."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, so3_exp
from scanloom.stages.loops.places import Settings, places
from tests.worlds import GROUND_Z_M, BoxWorld, observe

START_NS = 1_700_000_000_000_000_000


def block(seed: int = 0, size_m: float = 60.0) -> BoxWorld:
    """Houses of varied size inside and around a square of streets, with cars and poles along them."""
    rng = np.random.default_rng(seed)
    boxes = []
    half = size_m / 2
    for side in range(4):
        for offset, sign in ((8.0, 1.0), (-8.0, -1.0)):
            s = -half - 20
            while s < half + 20:
                width, depth, gap = rng.uniform(5, 12), rng.uniform(4, 8), rng.uniform(1, 5)
                near = half + offset + sign * rng.uniform(0, 3)
                low, high = sorted((near, near + sign * depth))
                a, b = (s, low), (s + width, high)
                if sign > 0 or (abs(s) < half - 10 and abs(s + width) < half - 10):
                    boxes.append(_turned(a, b, side, rng.uniform(3, 9)))
                s += width + gap
        for s in rng.uniform(-half, half, 5):
            boxes.append(
                _turned(
                    (s, half + 4.5),
                    (s + rng.uniform(3.5, 5), half + 6.2),
                    side,
                    GROUND_Z_M + rng.uniform(1.4, 2),
                )
            )
        for s in rng.uniform(-half, half, 4):
            boxes.append(_turned((s, half - 5), (s + 0.25, half - 4.75), side, rng.uniform(3, 6)))
    return BoxWorld(np.array(boxes))


def _turned(a: tuple[float, float], b: tuple[float, float], quarter: int, top: float) -> list[list[float]]:
    """A box along the upper street turned by quarters of a circle about the origin."""
    corners = np.array([a, b])
    for _ in range(quarter):
        corners = np.column_stack((-corners[:, 1], corners[:, 0]))
    low, high = corners.min(axis=0), corners.max(axis=0)
    return [[low[0], low[1], GROUND_Z_M], [high[0], high[1], top]]


def polyline(corners: list[tuple[float, float]], step_m: float = 1.0, z: float = 0.0) -> np.ndarray:
    """Poses (n, 4, 4) along straight legs, turning on the last metres before each corner."""
    p = np.array(corners, float)
    xy = [p[0]]
    for a, b in pairwise(p):
        n = int(np.linalg.norm(b - a) // step_m)
        xy += [a + (b - a) * k / n for k in range(1, n + 1)]
    at = np.array(xy)
    smooth = np.array([np.convolve(np.pad(c, 4, mode="edge"), np.ones(9) / 9, "valid") for c in at.T]).T
    heading = np.unwrap(np.arctan2(*np.gradient(smooth, axis=0).T[::-1]))
    return pose(
        so3_exp(np.column_stack((0 * heading, 0 * heading, heading))),
        np.column_stack((smooth, 0 * heading + z)),
    )


def scans_of(
    world: BoxWorld, T: np.ndarray, seed: int = 0, rows: int = 16, columns: int = 300, start_ns: int = START_NS,
    first_index: int = 0,
) -> list[DeskewedScan]:  # fmt: skip
    """One scan per pose, two a second; only boxes within 60 m are asked."""
    rng = np.random.default_rng(seed)
    out = []
    for k, pose_k in enumerate(T):
        at = pose_k[:3, 3]
        gap = np.maximum(np.maximum(world.boxes[:, 0] - at, at - world.boxes[:, 1]), 0)
        near = BoxWorld(world.boxes[np.linalg.norm(gap, axis=1) < 60])
        stamp = start_ns + k * 500_000_000
        out.append(
            observe(near, pose_k, index=first_index + k, stamp_ns=stamp, rng=rng, rows=rows, columns=columns)
        )
    return out


def labels_of(
    scans: list[DeskewedScan], T: np.ndarray, ground_z: np.ndarray | float = GROUND_Z_M
) -> list[ScanLabels]:
    out = []
    heights = np.broadcast_to(ground_z, len(T))
    for scan, pose_k, z in zip(scans, T, heights):
        world_z = scan.points() @ pose_k[2, :3] + pose_k[2, 3]
        classes = np.where(np.abs(world_z - z) < 0.15, PointClass.GROUND, PointClass.STATIC).astype(np.uint8)
        out.append(ScanLabels(class_=classes, reference_ns=scan.reference_ns, scan_index=scan.scan_index))
    return out


def odometry_of(
    T: np.ndarray, scans: list[DeskewedScan], drift_deg_per_100m: float = 0.5, seed: int = 0
) -> Odometry:
    """Truth with a steady yaw drift and a little noise."""
    rng = np.random.default_rng(seed)
    motion = inverse(T[:-1]) @ T[1:]
    noise = rng.normal(0, 1, (len(motion), 6)) * np.repeat([np.radians(0.01), 0.003], 3)
    noise[:, 2] += np.radians(drift_deg_per_100m) * np.linalg.norm(motion[:, :3, 3], axis=1) / 100
    track = [np.eye(4)]
    for m in motion @ se3_exp(noise):
        track.append(track[-1] @ m)
    n = len(T)
    return Odometry(
        scan_index=np.arange(n), stamp_ns=np.array([s.reference_ns for s in scans], np.int64), T_odom_lidar=np.array(track),
        covariance=np.broadcast_to(np.eye(6) * 1e-5, (n, 6, 6)).copy(), inlier_ratio=np.ones(n), rmse_m=np.full(n, 0.02),
        degeneracy_d=np.ones(n), degeneracy_e=np.full(n, 0.01), direction_p=np.ones((n, 6)),
        weak_directions=np.broadcast_to(np.eye(6), (n, 6, 6)).copy(), keyframe=np.ones(n, bool), reliable=np.ones(n, bool),
        segment=np.zeros(n, np.int32),
    )  # fmt: skip


def chunks(kind: type[Deskewed] | type[Labels], items: list, size: int = 50, session: str = "a") -> Parts:
    return Parts(
        [
            ((("session", session), ("chunk", f"{k:04d}")), kind(items[k * size : (k + 1) * size]))
            for k in range(-(-len(items) // size))
        ]
    )


def described(
    settings: Settings, clouds: Parts, classes: Parts, odometry: Odometry, session: str = "a"
) -> Parts:
    """Places of all chunks."""
    return Parts(
        [
            ((("session", session), ("chunk", f"{k:04d}")), places(settings, cloud, label, odometry))
            for k, (cloud, label) in enumerate(zip(clouds, classes, strict=True))
        ]
    )


def one(product: object, session: str = "a") -> Parts:
    return Parts([((("session", session),), product)])
