"""A painted wall behind a painted box, seen by one camera that stands still or moves along."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from scanloom.schemas.cameras import Camera, CameraModel, Cameras, Image, Images
from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass, ScanLabels
from scanloom.schemas.tiles import Paint, Piece, Tile
from scanloom.schemas.trajectory import Poses
from scanloom.stages.colour import Settings, brightness, colour
from scanloom.stages.colour.brightness import Settings as Brightness
from scanloom.stages.geometry.camera import rays
from scanloom.stages.geometry.se3 import F8, pose
from scanloom.stages.geometry.srgb import srgb
from scanloom.stages.logs.mounting import as_matrix4
from scanloom.stages.tiling import tiles, tiling
from scanloom.stages.tiling.pieces import Settings as TilingSettings
from scanloom.stages.tiling.tiles import Settings as TilesSettings
from tests.stages.mapping import poses_of, stamps

MODEL = CameraModel(
    lens="pinhole", width_px=640, height_px=400, fx_px=400, fy_px=400, cx_px=319.5, cy_px=199.5
)
R_LIDAR_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
CAMERA = Camera(name="front", model=MODEL, T_lidar_camera=as_matrix4(pose(R_LIDAR_CAMERA, np.zeros(3))))
START = np.array([5.0, 25.0, 3.0])
WALL_X_M, BOX_X_M, BOX_HALF_M = 20.0, 12.0, 1.0
"""The wall is 12 m wide and 6 m high; the box before it covers its middle."""
LEFT, RIGHT, BOX = (np.array(c) for c in ([0.4, 0.1, 0.1], [0.1, 0.1, 0.4], [0.1, 0.4, 0.1]))
"""Linear light."""


def points() -> tuple[F8, np.ndarray]:
    """Points (n, 3) of the map and what they are of: 0 wall, 1 box, 2 wall behind it."""
    y, z = (a.ravel() for a in np.meshgrid(np.arange(19, 31, 0.05), np.arange(0.05, 6, 0.05)))
    wall = np.column_stack((np.full(len(y), WALL_X_M + 0.05), y + 0.02, z))
    near = (np.abs(wall[:, 1] - 25) < BOX_HALF_M) & (np.abs(wall[:, 2] - 3) < BOX_HALF_M)
    box = wall[near] - (WALL_X_M - BOX_X_M, 0, 0)
    return np.concatenate((wall, box)), np.concatenate((np.where(near, 2, 0), np.ones(len(box), int)))


def pieces() -> Parts[Piece]:
    xyz, _ = points()
    x, y, z = np.ascontiguousarray((xyz - START).T.astype(np.float32))
    scan = DeskewedScan(
        x_m=x, y_m=y, z_m=z, intensity=np.ones(len(x), np.float32), reference_ns=int(stamps(1)[0]), scan_index=0
    )  # fmt: skip
    label = ScanLabels(np.full(len(x), PointClass.STATIC, np.uint8), scan.reference_ns, 0)
    made = tiling(TilingSettings(), Deskewed([scan]), FinalLabels([label]), path(1))
    return Parts([((("session", "a"), ("chunk", "0000"), ("tile", part.key)), part.product) for part in made])


def path(count: int, step_m: float = 0.0) -> Poses:
    """Along y."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = START + np.arange(count)[:, None] * (0.0, step_m, 0.0)
    return poses_of(T)


def picture(origin: F8 = START, exposure: float = 1.0) -> np.ndarray:
    """(h, w, 3) red green blue."""
    v, u = np.mgrid[: MODEL.height_px, : MODEL.width_px]
    d = rays(MODEL, np.column_stack((u.ravel(), v.ravel())).astype(float)) @ R_LIDAR_CAMERA.T
    box, wall = (origin + d * ((x - origin[0]) / d[:, :1]) for x in (BOX_X_M, WALL_X_M))
    light = np.where(wall[:, 1:2] > 25.0, LEFT, RIGHT)
    light[(np.abs(box[:, 1] - 25) < BOX_HALF_M) & (np.abs(box[:, 2] - 3) < BOX_HALF_M)] = BOX
    light[(np.abs(wall[:, 1] - 25) > 6) | (np.abs(wall[:, 2] - 3) > 3)] = 0.0
    return srgb(light * exposure).reshape(MODEL.height_px, MODEL.width_px, 3)


def image(pixels: np.ndarray, n: int = 0, camera: str = "front") -> Image:
    data = np.asarray(cv2.imencode(".png", pixels[..., ::-1])[1], np.uint8).reshape(-1)
    return Image(data=data, stamp_ns=int(stamps(n + 1)[n]), camera=camera, encoding="png", topic="/front")


def painted(
    images: Sequence[Image], poses: Poses, tracks: ObjectTracks | None = None, camera: Camera = CAMERA, **settings: float
) -> list[tuple[str, Paint]]:  # fmt: skip
    made = colour(
        Settings(**settings), Images(images), Cameras(cameras=(camera,)), poses,
        tracks if tracks is not None else ObjectTracks.empty(), pieces(),
    )  # fmt: skip
    return [(part.key, part.product) for part in made]


def tile(paints: Sequence[tuple[str, Paint]], **settings: float) -> Tile:
    """The one tile of the scene."""
    keyed = Parts(
        [
            ((("session", "a"), ("footage", f"{n:04d}"), ("tile", key)), paint)
            for n, (key, paint) in enumerate(paints)
        ]
    )
    colours = [
        ((("session", "a"), ("tile", part.key)), part.product)
        for part in brightness(Brightness(**settings), keyed)
    ]
    return tiles(TilesSettings(), pieces(), Parts(colours))[0]
