"""A rig before a board, in numbers only: rays meet planes, corners meet lenses, noise on both. Milliseconds a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.evidence import SENSOR
from scanloom.stages.calibrate.image import ImageBoard
from scanloom.stages.calibrate.rays import Bearings, board_pose
from scanloom.stages.calibrate.scene import Placement, Scene
from scanloom.stages.calibrate.view import LidarView, moved
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, so3_exp, transform

BOARD = Board(inner_corners=(7, 5), square_m=0.095, board_m=(0.85, 0.61), offset_m=(0.0, 0.0))
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (right, down, forward) of a camera that looks along the LiDAR's x, as columns in the LiDAR's frame."""


@dataclass(frozen=True)
class World:
    """What is simulated."""

    cameras: int = 3
    placements: int = 12
    range_sigma_m: float = 0.02
    corner_sigma_px: float = 0.2
    range_offset_m: float = 0.005
    """All ranges read too long by this, and each beam by as much again, one sigma."""
    beams: int = 32
    elevation_deg: tuple[float, float] = (-20.0, 15.0)
    azimuth_step_deg: float = 0.2
    distance_m: tuple[float, float] = (2.0, 4.0)
    board: Board = field(default_factory=lambda: BOARD)

    def heading(self, camera: int) -> float:
        """Where a camera looks, rad from the LiDAR's x."""
        return float(np.radians(40.0) * (camera - (self.cameras - 1) / 2))


def model(lens: int) -> CameraModel:
    """Three lenses in turn: radial-tangential, equidistant, pinhole."""
    size = {"width_px": 1280, "height_px": 960, "cx_px": 643.2, "cy_px": 475.1}
    if lens % 3 == 0:
        return CameraModel(
            lens="radial-tangential", fx_px=720.0, fy_px=721.5, distortion=(-0.21, 0.06, 4e-4, -3e-4), **size
        )
    if lens % 3 == 1:
        return CameraModel(
            lens="equidistant", fx_px=610.0, fy_px=609.0, distortion=(-0.012, 0.004, -0.002, 3e-4), **size
        )
    return CameraModel(lens="pinhole", fx_px=800.0, fy_px=800.0, **size)


def rig(world: World, rng: np.random.Generator) -> tuple[dict[str, CameraModel], dict[str, F8]]:
    """Cameras 40 degrees apart, each mounted with an error of some degrees and centimetres."""
    models, poses = {}, {}
    for i in range(world.cameras):
        heading = world.heading(i)
        off = np.r_[rng.normal(0, np.radians(3), 3), rng.normal(0, 0.05, 3)]
        ideal = pose(so3_exp((0.0, 0.0, heading)) @ _AXES, so3_exp((0.0, 0.0, heading)) @ (0.2, 0.0, -0.15))
        models[f"cam{i}"] = model(i)
        poses[f"cam{i}"] = ideal @ se3_exp(off)
    return models, poses


def simulate(world: World, seed: int) -> tuple[Scene, dict[str, F8]]:
    """A scene and the true poses of its cameras. Corners are numbered in either order, as an image leaves it open."""
    rng = np.random.default_rng(seed)
    models, poses = rig(world, rng)
    offsets = world.range_offset_m * (rng.normal() + rng.normal(size=world.beams))
    placements: list[Placement] = []
    while len(placements) < world.placements:
        T_lidar_board = _stand(world, world.heading(len(placements) % world.cameras), rng)
        images = {
            camera: seen
            for camera, lens in models.items()
            if (seen := photograph(world, lens, poses[camera], T_lidar_board, rng)) is not None
        }
        cloud = scan(world, offsets, T_lidar_board, rng)
        if images and cloud is not None:
            placements.append(Placement(f"place{len(placements) + 1}", cloud, images))
    return Scene.of(world.board, models, tuple(placements)), poses


def _stand(world: World, ahead: float, rng: np.random.Generator) -> F8:
    """A board hung as a diamond somewhere before a camera, tilted and turned as hands do."""
    heading = ahead + np.radians(rng.uniform(-25.0, 25.0))
    away = rng.uniform(*world.distance_m)
    place = away * np.array([np.cos(heading), np.sin(heading), rng.uniform(-0.15, 0.1)])
    facing = so3_exp((0.0, 0.0, heading)) @ np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    tilt = np.radians(rng.uniform(-35.0, 35.0, 2))
    spin = np.radians(rng.choice([45.0, -45.0]) + rng.uniform(-15.0, 15.0))
    return pose(facing @ so3_exp((tilt[0], tilt[1], 0.0)) @ so3_exp((0.0, 0.0, spin)), place)


def photograph(
    world: World, lens: CameraModel, T_lidar_camera: F8, T_lidar_board: F8, rng: np.random.Generator
) -> ImageBoard | None:
    """Corners of a board that is wholly in the image."""
    corners = world.board.corners_m()
    T_camera_board = inverse(T_lidar_camera) @ T_lidar_board
    _, whole = project(lens, transform(T_camera_board, world.board.outline_m()))
    pixels, seen = project(lens, transform(T_camera_board, corners))
    if not (whole.all() and seen.all()) or -T_camera_board[:3, 2] @ _unit(T_camera_board[:3, 3]) < 0.2:
        return None
    pixels = pixels + rng.normal(0, world.corner_sigma_px, pixels.shape)
    fit = board_pose(Bearings.of(lens, pixels), corners)
    if fit is None:
        return None
    board = ImageBoard(np.arange(len(corners)), pixels, world.board.ambiguity, fit.rms_px, fit.T_camera_board)
    return board.turned(world.board, int(rng.integers(world.board.ambiguity)))


def scan(world: World, offsets: F8, T_lidar_board: F8, rng: np.random.Generator) -> LidarView | None:
    """Points with range noise, and per ring the rays between the last on the board and the first beside it."""
    directions, row = _rays_towards(world, T_lidar_board)
    x, reach = _met(T_lidar_board, directions)
    low, high = world.board.outline_m()[0, :2], world.board.outline_m()[2, :2]
    on = ((x > low) & (x < high)).all(axis=1)
    plane = (
        directions[on]
        * (reach[on] + offsets[row[on]] + rng.normal(0, world.range_sigma_m, on.sum()))[:, None]
    )
    changes = np.flatnonzero((on[1:] != on[:-1]) & (row[1:] == row[:-1]))
    if len(plane) < 50 or len(changes) < 8:
        return None
    edges = _Edges.between(world, x[changes], x[changes + 1], directions, changes)
    return _view(world, T_lidar_board, plane, row[on], edges)


@dataclass(frozen=True)
class _Edges:
    """Rays through the outline, and the side each one crosses."""

    directions: F8
    normals: F8
    offsets_m: F8
    sigma_m: F8

    @classmethod
    def between(cls, world: World, on: F8, off: F8, directions: F8, at: NDArray[np.int64]) -> _Edges:
        low, high = world.board.outline_m()[0, :2], world.board.outline_m()[2, :2]
        x, y = ((on + off) / 2).T
        gaps = np.abs(np.stack((low[0] - x, x - high[0], low[1] - y, y - high[1]), 1))
        side = np.argmin(gaps, axis=1)
        normals = np.array([(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])[side]
        offsets = np.array([-low[0], high[0], -low[1], high[1]])[side]
        across = np.abs((normals * (off - on)).sum(axis=1))
        return cls(
            directions[at] + directions[at + 1], normals, offsets, np.maximum(across / np.sqrt(12), 1e-3)
        )


def _view(world: World, T_start: F8, plane: F8, row: NDArray[np.int64], edges: _Edges) -> LidarView:
    """The rows of ranges and edges at their best pose, derivatives by differences."""
    beams, beam = np.unique(row, return_inverse=True)

    def rows(T: F8) -> F8:
        normal, middle = T[:3, 2], T[:3, 3]
        reach = np.linalg.norm(plane, axis=1)
        expected = (normal @ middle) / (plane / reach[:, None] @ normal)
        x = (edges.directions * ((normal @ middle) / (edges.directions @ normal))[:, None] - middle) @ T[
            :3, :2
        ]
        off = ((edges.normals * x).sum(axis=1) - edges.offsets_m) / edges.sigma_m
        return np.concatenate(((reach - expected) / world.range_sigma_m, off))

    def slopes(T: F8) -> F8:
        steps = 1e-6 * np.eye(6)
        return np.stack([(rows(moved(T, s)) - rows(moved(T, -s))) / 2e-6 for s in steps], axis=1)

    T = T_start
    for _ in range(5):
        J = slopes(T)
        T = moved(T, -np.linalg.solve(J.T @ J, J.T @ rows(T)))
    by_sensor = np.zeros((len(plane) + len(edges.sigma_m), len(SENSOR) + len(beams)))
    by_sensor[np.arange(len(plane)), len(SENSOR) + beam] = -1.0 / world.range_sigma_m
    by_sensor[: len(plane), SENSOR.index("farther_m")] = -1.0 / world.range_sigma_m
    by_sensor[len(plane) :, 0] = -1.0 / edges.sigma_m
    triangle = np.linalg.qr(np.column_stack((slopes(T), by_sensor, rows(T))), mode="r")
    return LidarView(T, beams, triangle[:-1, :-1], triangle[:-1, -1], len(plane), len(edges.sigma_m))


def _rays_towards(world: World, T_lidar_board: F8) -> tuple[F8, F8]:
    """Directions (n, 3) of a turning sensor around the board, row by row, and their rows."""
    place = T_lidar_board[:3, 3]
    heading, half = np.arctan2(place[1], place[0]), 1.0 / np.linalg.norm(place[:2])
    step = np.radians(world.azimuth_step_deg)
    azimuth = step * np.arange(np.floor((heading - half) / step), np.ceil((heading + half) / step))
    elevation = np.radians(np.linspace(*world.elevation_deg, world.beams))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
    directions = np.column_stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))
    return directions, np.repeat(np.arange(world.beams), len(azimuth))


def _met(T_lidar_board: F8, directions: F8) -> tuple[F8, F8]:
    """Where rays meet the board's plane, (n, 2) in its frame, and how far along."""
    normal, middle = T_lidar_board[:3, 2], T_lidar_board[:3, 3]
    reach = (normal @ middle) / (directions @ normal)
    x = (directions * reach[:, None] - middle) @ T_lidar_board[:3, :2]
    return np.where((reach > 0)[:, None], x, np.inf), reach


def _unit(v: F8) -> F8:
    return np.asarray(v / np.linalg.norm(v))


def shifted(placement: Placement, T_move: F8) -> Placement:
    """The board moved between cloud and images: its points lie elsewhere, `T_move` in the LiDAR's frame."""
    cloud = placement.cloud
    return replace(placement, cloud=replace(cloud, T_lidar_board=T_move @ cloud.T_lidar_board))


def glared(
    placement: Placement, models: Mapping[str, CameraModel], board: Board, rng: np.random.Generator
) -> Placement:
    """A reflection draws the corners of a third of the board some pixels towards itself, in every image."""
    images = {}
    for camera, seen in placement.images.items():
        middle = seen.pixels[rng.integers(len(seen.pixels))]
        near = np.argsort(np.linalg.norm(seen.pixels - middle, axis=1))[: len(seen.pixels) // 3]
        pixels = seen.pixels.copy()
        pixels[near] += rng.normal(4.0, 2.0, 2) + rng.normal(0, 2.0, (len(near), 2))
        fit = board_pose(Bearings.of(models[camera], pixels), board.corners_m()[seen.index])
        if fit is not None:
            images[camera] = replace(
                seen, pixels=pixels, sigma_px=fit.rms_px, T_camera_board=fit.T_camera_board
            )
    return replace(placement, images=images)


def other_board(
    placement: Placement,
    models: Mapping[str, CameraModel],
    poses: Mapping[str, F8],
    world: World,
    rng: np.random.Generator,
) -> Placement:
    """The images show a board with squares of four fifths, in the same place."""
    small = world.board.model_copy(update={"square_m": 0.8 * world.board.square_m})
    images = {}
    for camera, seen in placement.images.items():
        there = transform(
            inverse(poses[camera]) @ placement.cloud.T_lidar_board, small.corners_m()[seen.index]
        )
        pixels, _ = project(models[camera], there)
        pixels = pixels + rng.normal(0, world.corner_sigma_px, pixels.shape)
        fit = board_pose(Bearings.of(models[camera], pixels), world.board.corners_m()[seen.index])
        if fit is not None:
            images[camera] = replace(
                seen, pixels=pixels, sigma_px=fit.rms_px, T_camera_board=fit.T_camera_board
            )
    return replace(placement, images=images)
