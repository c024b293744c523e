"""What users of other tools miss: placements left out and predicted, halves compared, all in pixels and centimetres."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.graph import Estimate
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.rays import Bearings, on_board
from scanloom.stages.calibrate.scene import Placement, Scene
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, se3_log, transform

Solver = Callable[[Scene, Mapping[str, F8], Noise], Estimate]
Where = tuple[str, str]
"""Placement and camera."""


@dataclass(frozen=True)
class Miss:
    """How far the corners of one image are from the LiDAR's board: root mean squares, and how many."""

    px: float
    cm: float
    corners: int


@dataclass(frozen=True)
class Spread:
    """How calibrations from random halves of the placements differ from their mean."""

    halves: int
    rotation_max_rad: float
    rotation_rms_rad: float
    translation_max_m: float
    translation_rms_m: float


@dataclass(frozen=True)
class Checks:
    """All figures."""

    residual: dict[Where, Miss]
    """By the calibration itself."""
    left_out: dict[Where, Miss]
    """By a calibration without that placement."""
    left_out_as_read: dict[Where, Miss]
    """The same with the ranges as the LiDAR read them."""
    held_out: dict[Where, list[Miss]]
    """By calibrations of random halves that did not hold that placement."""
    spread: dict[str, Spread]


def check(
    scene: Scene, estimate: Estimate, noise: Noise, settings: CalibrateSettings, solver: Solver
) -> Checks:
    """Leave each placement out in turn, then calibrate random halves and measure the other halves."""
    left_out: dict[Where, Miss] = {}
    as_read: dict[Where, Miss] = {}
    for p in scene.placements:
        others = scene.only(name for name in scene.names if name != p.name)
        without = solver(others, estimate.T_lidar_camera, noise)
        left_out |= misses(scene, p, without, noise)
        as_read |= misses(scene, p, without, noise, as_read=True)
    held_out, spread = _halves(scene, estimate, noise, settings, solver)
    residual = {
        where: miss for p in scene.placements for where, miss in misses(scene, p, estimate, noise).items()
    }
    return Checks(residual, left_out, as_read, held_out, spread)


def misses(
    scene: Scene, p: Placement, known: Estimate, noise: Noise, *, as_read: bool = False
) -> dict[Where, Miss]:
    """The LiDAR's board of a placement against its images, by a calibration."""
    T_lidar_board = p.cloud.T_lidar_board if as_read else known.board_by_cloud(p, noise)
    found = {}
    for camera, seen in p.images.items():
        if camera not in known.T_lidar_camera:
            continue
        corners = scene.corners(p, camera)
        found[p.name, camera] = miss(
            known.models[camera], inverse(known.T_lidar_camera[camera]) @ T_lidar_board, corners, seen.pixels
        )
    return found


def miss(model: CameraModel, T_camera_board: F8, corners: F8, pixels: F8) -> Miss:
    """Corners (n, 3) of a board against pixels (n, 2)."""
    there, _ = project(model, transform(T_camera_board, corners))
    px = there - pixels
    met = on_board(inverse(T_camera_board), Bearings.of(model, pixels).directions)
    cm = 100.0 * (met - corners[:, :2])
    return Miss(_rms(px), _rms(cm), len(corners))


def _rms(errors: F8) -> float:
    squares = (errors**2).sum(axis=1)
    return float(np.sqrt(squares.mean())) if np.isfinite(squares).all() else float("inf")


def together(found: list[Miss]) -> Miss:
    """Over all corners of several images."""
    n = sum(m.corners for m in found)
    if not n:
        return Miss(float("nan"), float("nan"), 0)
    px = np.sqrt(sum(m.corners * m.px**2 for m in found) / n)
    cm = np.sqrt(sum(m.corners * m.cm**2 for m in found) / n)
    return Miss(float(px), float(cm), n)


def _halves(
    scene: Scene, estimate: Estimate, noise: Noise, settings: CalibrateSettings, solver: Solver
) -> tuple[dict[Where, list[Miss]], dict[str, Spread]]:
    rng = np.random.default_rng(settings.seed)
    held_out: dict[Where, list[Miss]] = {}
    tangents: dict[str, list[F8]] = {camera: [] for camera in scene.cameras}
    size = (len(scene.placements) + 1) // 2
    if size < 2:
        return held_out, {}
    for _ in range(settings.halves):
        names = {scene.names[i] for i in rng.permutation(len(scene.names))[:size]}
        half = _seen_twice(scene.only(names))
        if not half.models:
            continue
        known = solver(half, estimate.T_lidar_camera, noise)
        for camera, T in known.T_lidar_camera.items():
            tangents[camera].append(se3_log(inverse(estimate.T_lidar_camera[camera]) @ T))
        for p in scene.placements:
            if p.name not in names:
                for where, found in misses(scene, p, known, noise).items():
                    held_out.setdefault(where, []).append(found)
    return held_out, {c: _spread(estimate.T_lidar_camera[c], np.array(t)) for c, t in tangents.items() if t}


def _seen_twice(scene: Scene) -> Scene:
    """Without cameras that saw one board only: one board's own error would be all of theirs."""
    once = {camera for camera in scene.cameras if len(scene.seen_by(camera)) < 2}
    return scene.without((p.name, camera) for p in scene.placements for camera in once)


def _spread(T: F8, tangents: F8) -> Spread:
    mean = T @ se3_exp(tangents.mean(axis=0))
    off = np.array([se3_log(inverse(mean) @ T @ se3_exp(xi)) for xi in tangents])
    turn = np.linalg.norm(off[:, :3], axis=1)
    shift = np.array([np.linalg.norm((T @ se3_exp(xi))[:3, 3] - mean[:3, 3]) for xi in tangents])
    return Spread(
        len(tangents), float(turn.max()), float(np.sqrt((turn**2).mean())),
        float(shift.max()), float(np.sqrt((shift**2).mean())),
    )  # fmt: skip
