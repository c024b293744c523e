"""A street of boxes and painted ground, seen by a camera and a LiDAR whose reflectance is another than the grey."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from scanloom.schemas.cameras import Camera, CameraModel, Image, Images
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.camera import rays
from scanloom.stages.geometry.se3 import inverse, pose, so3_exp
from scanloom.stages.logs.mounting import as_matrix4

MODEL = CameraModel(
    lens="radial-tangential", width_px=480, height_px=300, fx_px=290, fy_px=288, cx_px=236, cy_px=152,
    distortion=(-0.12, 0.03, 5e-4, -3e-4),
)  # fmt: skip
T_LIDAR_CAMERA = pose(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ so3_exp([0.03, -0.02, 0.01]), [0.4, 0.15, -0.35]
)
MATERIALS = 24
HEIGHT_M = 1.8


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def cast(origin, directions, boxes):  # type: ignore[no-untyped-def]
    """First hit of each ray: distance, number of the box (-1 ground, -2 none), face (axis)."""
    n = len(directions)
    far, hit, face = np.full(n, np.inf), np.full(n, -2), np.zeros(n, np.int64)
    for i in range(n):
        d = directions[i]
        if d[2] < -1e-6:
            far[i], hit[i], face[i] = -origin[2] / d[2], -1, 2
        for b in range(len(boxes)):
            enter, leave, axis = 1e-3, far[i], -1
            for k in range(3):
                inv = 1.0 / d[k] if abs(d[k]) > 1e-9 else 1e9
                s, e = (boxes[b, k] - origin[k]) * inv, (boxes[b, 3 + k] - origin[k]) * inv
                if s > e:
                    s, e = e, s
                if s > enter:
                    enter, axis = s, k
                leave = min(leave, e)
            if axis >= 0 and enter < leave:
                far[i], hit[i], face[i] = enter, b, axis
    return far, hit, face


@dataclass
class Street:
    """A world of one seed. `likeness` says how far reflectance follows grey (1 wholly, 0 not at all)."""

    seed: int
    likeness: float = 0.6

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 1])
        boxes = []
        for side in (-1, 1):
            x = -20.0
            while x < 140:
                length, depth, back = rng.uniform(5, 14), rng.uniform(4, 8), rng.uniform(7, 13)
                if rng.random() < 0.8:
                    boxes.append([x, back, 0, x + length, back + depth, rng.uniform(4, 11)])
                    boxes[-1][1:5:3] = sorted((side * back, side * (back + depth)))
                x += length + rng.uniform(0.5, 5)
        for _ in range(45):
            x, y, s = rng.uniform(-10, 140), rng.choice((-1, 1)) * rng.uniform(3.2, 7), rng.uniform(0.3, 2.2)
            boxes.append(
                [
                    x,
                    y - s / 2,
                    0,
                    x + s * rng.uniform(0.5, 2.5),
                    y + s / 2,
                    rng.uniform(0.6, 2.4) + (s < 0.6) * 2.5,
                ]
            )
        self.boxes = np.array(boxes)
        self.grey = rng.uniform(0.05, 0.95, MATERIALS)
        self.nir = self.likeness * self.grey + (1 - self.likeness) * rng.uniform(0.05, 0.95, MATERIALS)
        self.cell = rng.uniform(0.6, 2.5, len(boxes) + 1)

    def material(self, points: np.ndarray, hit: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Panels on walls, patches and lane marks on the ground."""
        cell = self.cell[hit + 1]
        a = np.where(face == 0, points[:, 1], points[:, 0])
        b = np.where(face == 2, points[:, 1], points[:, 2])
        i, j = (
            np.floor(a / np.where(hit == -1, 4.0, cell)).astype(np.int64),
            np.floor(b / np.where(hit == -1, 2.5, cell)).astype(np.int64),
        )
        mixed = (i * 73856093) ^ (j * 19349663) ^ (hit * 83492791) ^ (self.seed * 2654435761)
        # most of a wall, and of a road, is of one kind
        base = (hit * 7919 + self.seed * 31) % MATERIALS
        mark = (hit == -1) & ((np.abs(np.abs(points[:, 1]) - 1.7) < 0.08) & (points[:, 0] % 6 < 3))
        kind = np.where((mixed >> 5) % 3 == 0, (mixed >> 9) % MATERIALS, base)
        return np.where(mark, int(np.argmax(self.grey + self.nir)), kind)

    def image(self, T_world_camera: np.ndarray, model: CameraModel, rng: np.random.Generator) -> np.ndarray:
        """From poses (k, 4, 4), of k bands of rows."""
        v, u = np.mgrid[: model.height_px, : model.width_px]
        local = rays(model, np.column_stack((u.ravel(), v.ravel())).astype(float))
        seen = []
        for T, band in zip(T_world_camera, np.array_split(np.arange(model.height_px), len(T_world_camera))):
            directions = local[np.isin(v.ravel(), band)] @ T[:3, :3].T
            far, hit, face = cast(T[:3, 3].copy(), np.ascontiguousarray(directions), self.boxes)
            points = T[:3, 3] + directions * np.where(np.isfinite(far), far, 0.0)[:, None]
            seen.append((points, hit, face))
        points, hit, face = (np.concatenate(column) for column in zip(*seen))
        light = np.array([0.75, 0.5, 1.0])[face]
        shade = 1 - 0.5 * (
            (np.sin(points[:, 0] * 0.9 + self.seed) + np.sin(points[:, 1] * 1.3) > 0.9) & (hit == -1)
        )
        grey = np.where(hit > -2, self.grey[self.material(points, hit, face)] * light * shade, 0.9)
        grey = 230 * rng.uniform(0.7, 1.2) * grey + rng.normal(0, 4, len(grey))
        return cv2.GaussianBlur(grey.clip(0, 255).astype(np.uint8).reshape(model.height_px, -1), (0, 0), 0.6)

    def scan(self, T_world_lidar: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        azimuth, elevation = np.meshgrid(
            np.radians(np.arange(-180, 180, 0.4)), np.radians(np.linspace(-25, 10, 32))
        )
        azimuth = azimuth + rng.uniform(0, np.radians(0.4))
        local = np.stack(
            (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), -1
        ).reshape(-1, 3)
        directions = np.ascontiguousarray(local @ T_world_lidar[:3, :3].T)
        far, hit, face = cast(T_world_lidar[:3, 3].copy(), directions, self.boxes)
        seen = far < 80
        points = T_world_lidar[:3, 3] + directions[seen] * far[seen, None]
        nir = self.nir[self.material(points, hit[seen], face[seen])]
        slant = np.abs(directions[seen, face[seen]])
        strength = 255 * nir * np.sqrt(slant) * np.exp(-far[seen] / 60) * rng.normal(1, 0.08, len(points))
        return local[seen] * (far[seen] + rng.normal(0, 0.015, len(points)))[:, None], strength


@dataclass
class Recorded:
    """What the check reads of a session."""

    images: Parts[Images]
    deskewed: Parts[Deskewed]
    labels: Parts[Labels]
    odometry: Odometry


def record(
    street: Street, images: int = 24, scans: int = 3, step_m: float = 4.0, readout_s: float = 0.0
) -> Recorded:
    """A drive along the street with an image every `step_m`, `scans` scans around each, in two chunks and two parts."""
    bands = np.linspace(-0.5, 0.5, 30) if readout_s > 0 else np.zeros(1)
    rng = np.random.default_rng([street.seed, 2])
    pictures, clouds, stamps, poses = [], [], [], []
    for n in range(images):
        at_ns = 10**9 + n * 400_000_000
        for k in range(scans):
            ns = at_ns + (k - scans // 2) * 100_000_000
            T = path(ns, step_m)
            xyz, strength = street.scan(T, rng)
            x, y, z = xyz.astype(np.float32).T.copy()
            clouds.append(
                DeskewedScan(
                    x_m=x,
                    y_m=y,
                    z_m=z,
                    intensity=strength.astype(np.float32),
                    reference_ns=ns,
                    scan_index=len(clouds),
                )
            )
            stamps.append(ns)
            poses.append(T)
        times = at_ns + 20_000_000 + (1e9 * readout_s * bands).astype(np.int64)
        seen = street.image(np.stack([path(int(t), step_m) for t in times]) @ T_LIDAR_CAMERA, MODEL, rng)
        data = np.asarray(cv2.imencode(".png", seen)[1], np.uint8).reshape(-1)
        pictures.append(
            Image(data=data, stamp_ns=at_ns + 20_000_000, camera="front", encoding="png", topic="/front")
        )
    labels = [
        ScanLabels(
            class_=np.full(len(c), PointClass.STATIC, np.uint8),
            reference_ns=c.reference_ns,
            scan_index=c.scan_index,
        )
        for c in clouds
    ]
    half, middle = len(clouds) // 2, len(pictures) // 2
    return Recorded(
        _parts("footage", [Images(pictures[:middle]), Images(pictures[middle:])]),
        _parts("chunk", [Deskewed(clouds[:half]), Deskewed(clouds[half:])]),
        _parts("chunk", [Labels(labels[:half]), Labels(labels[half:])]),
        odometry(np.array(stamps), np.array(poses)),
    )  # fmt: skip


def path(ns: int, step_m: float) -> np.ndarray:
    """Where the LiDAR is: along the street, swaying."""
    s = (ns - 10**9) / 4e8
    T = pose(
        so3_exp([0.01 * np.sin(s), 0.01 * np.cos(0.7 * s), 0.05 * np.sin(0.5 * s)]),
        [s * step_m, 0.4 * np.sin(0.4 * s), HEIGHT_M],
    )
    return np.asarray(T)


def odometry(stamps: np.ndarray, T: np.ndarray) -> Odometry:
    n = len(stamps)
    return Odometry(
        scan_index=np.arange(n), stamp_ns=stamps, T_odom_lidar=inverse(T[0]) @ T, covariance=np.zeros((n, 6, 6)), inlier_ratio=np.ones(n),
        rmse_m=np.zeros(n), degeneracy_d=np.ones(n), degeneracy_e=np.zeros(n), direction_p=np.ones((n, 6)), weak_directions=np.zeros((n, 6, 6)),
        keyframe=np.ones(n, bool), reliable=np.ones(n, bool), segment=np.zeros(n, np.int32),
    )  # fmt: skip


def _parts(axis: str, products: list) -> Parts:  # type: ignore[type-arg]
    return Parts([((("session", "a"), (axis, f"{n:04d}")), p) for n, p in enumerate(products)])


def mounted(offset_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    """The camera by a calibration from before it was turned by `offset_deg` about its own axes: it now stands at T Exp(offset)."""
    T = T_LIDAR_CAMERA @ inverse(pose(so3_exp(np.radians(offset_deg)), np.zeros(3)))
    return Camera(name="front", model=MODEL, T_lidar_camera=as_matrix4(T), source="calibration")
