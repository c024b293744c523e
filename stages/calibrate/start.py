"""Where the optimisation starts: the order of the corners, then EPnP with RANSAC over all corners of all placements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scanloom.stages.calibrate.image import ImageBoard, board_turn
from scanloom.stages.calibrate.rays import Bearings, facing
from scanloom.stages.calibrate.scene import Placement, Scene
from scanloom.stages.calibrate.view import LidarView
from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_exp, transform

_AGREE = 0.15
"""Corners of a placement agree with a candidate when they are this share of the board's distance from it, or nearer."""
_RANSAC_PLANE = 0.03
_SEED = 20260
_LEAST_FORWARD = 0.17
"""Corners nearer than this (sine) to the edge of a half-space are of no use to EPnP, which works on a plane."""


@dataclass(frozen=True)
class Start:
    """A first pose of each camera, and the scene with all corners in orders that fit it."""

    scene: Scene
    T_lidar_camera: dict[str, F8]
    agreeing: dict[str, tuple[str, ...]]
    """By camera: placements that agree with it; all where a start was given, which may be far off."""


def start(scene: Scene, given: Mapping[str, F8] | None = None) -> Start:
    """Orders resolved over all placements jointly, then EPnP; a pose that is given replaces both for its camera.

    Each placement and order alone puts the camera somewhere; the right ones meet in one place, wrong ones do not as
    soon as two boards stand differently.
    """
    poses, agreeing = {}, {}
    ordered = {p.name: dict(p.images) for p in scene.placements}
    for camera in scene.cameras:
        told = (given or {}).get(camera)
        rough = told if told is not None else _consensus(scene, camera)
        for p in scene.placements:
            if camera in p.images:
                ordered[p.name][camera] = _fitting(
                    scene, p, p.images[camera], rough, by_turn=told is not None
                )
        here = replace(scene, placements=_reordered(scene, ordered))
        if told is not None:
            poses[camera], agreeing[camera] = told, tuple(p.name for p in here.seen_by(camera))
            continue
        near = _agreeing(here, camera, rough)
        poses[camera], agreeing[camera] = epnp(here, camera, near, rough), near
    return Start(replace(scene, placements=_reordered(scene, ordered)), poses, agreeing)


def same_boards(scene: Scene) -> Scene:
    """Of several boards in a cloud the one that the images show: the choice with which most placements agree."""
    if not any(p.others for p in scene.placements):
        return scene
    corners = scene.board.outline_m()
    rough = {camera: _consensus(scene, camera) for camera in scene.cameras}

    def cost(p: Placement, cloud: LidarView) -> float:
        return sum(
            min(_misfit(rough[c], cloud.T_lidar_board, seen, corners)[0], _AGREE)
            for c, seen in p.images.items()
        )

    chosen = (
        replace(p, cloud=min((p.cloud, *p.others), key=partial(cost, p)), others=()) for p in scene.placements
    )
    return replace(scene, placements=tuple(chosen))


def _reordered(scene: Scene, ordered: Mapping[str, Mapping[str, ImageBoard]]) -> tuple[Placement, ...]:
    return tuple(replace(p, images=ordered[p.name]) for p in scene.placements)


def _consensus(scene: Scene, camera: str) -> F8:
    """The candidate that the most placements agree with, by the sum of their distances, each limited."""
    views = [(_boards(p), p.images[camera]) for p in scene.placements if camera in p.images]
    corners = scene.board.outline_m()
    candidates = [
        T_lidar_board @ inverse(seen.T_camera_board @ board_turn(turn, _turns(seen)))
        for boards, seen in views
        for T_lidar_board in boards
        for turn in range(_turns(seen))
    ]
    costs = [
        sum(min(_AGREE, *(_misfit(T, board, seen, corners)[0] for board in boards)) for boards, seen in views)
        for T in candidates
    ]
    return candidates[int(np.argmin(costs))]


def _boards(p: Placement) -> list[F8]:
    return [view.T_lidar_board for view in (p.cloud, *p.others)]


def _turns(seen: ImageBoard) -> int:
    return max(seen.turns, 1)


def _misfit(T_lidar_camera: F8, T_lidar_board: F8, seen: ImageBoard, corners: F8) -> tuple[float, int]:
    """Root mean square distance of points of the board by image and by cloud, of its distance, in the best order."""
    there = transform(T_lidar_board, corners)
    away = np.linalg.norm(there.mean(axis=0))
    found = []
    for turn in range(_turns(seen)):
        T = T_lidar_camera @ seen.T_camera_board @ board_turn(turn, _turns(seen))
        found.append(np.sqrt(((transform(T, corners) - there) ** 2).sum(axis=1).mean()) / away)
    return float(min(found)), int(np.argmin(found))


def _fitting(
    scene: Scene, p: Placement, seen: ImageBoard, T_lidar_camera: F8, *, by_turn: bool
) -> ImageBoard:
    """The corners in the order that fits a camera; by directions alone where its pose may be half a metre off."""
    corners = scene.board.outline_m()
    if not by_turn:
        return seen.turned(scene.board, _misfit(T_lidar_camera, p.cloud.T_lidar_board, seen, corners)[1])
    R = p.cloud.T_lidar_board[:3, :3].T @ T_lidar_camera[:3, :3] @ seen.T_camera_board[:3, :3]
    likeness = [np.trace(R @ board_turn(turn, _turns(seen))[:3, :3]) for turn in range(_turns(seen))]
    return seen.turned(scene.board, int(np.argmax(likeness)))


def _agreeing(scene: Scene, camera: str, T_lidar_camera: F8) -> tuple[str, ...]:
    outline = scene.board.outline_m()
    return tuple(
        p.name
        for p in scene.placements
        if camera in p.images
        and _misfit(T_lidar_camera, p.cloud.T_lidar_board, replace(p.images[camera], turns=1), outline)[0]
        < _AGREE
    )


def epnp(scene: Scene, camera: str, names: tuple[str, ...], otherwise: F8) -> F8:
    """EPnP (Lepetit, Moreno-Noguer, Fua 2009) in RANSAC over all pairs, on a plane across the middle of them."""
    import cv2

    points, directions = virtual_pairs(scene, camera, names)
    R = facing(directions)
    turned = directions @ R.T
    ahead = turned[:, 2] > _LEAST_FORWARD
    if ahead.sum() < 6:
        return otherwise
    plane = turned[ahead, :2] / turned[ahead, 2:]
    cv2.setRNGSeed(_SEED)
    found, turn, shift, _ = cv2.solvePnPRansac(
        np.ascontiguousarray(points[ahead]),
        np.ascontiguousarray(plane),
        np.eye(3),
        None,
        iterationsCount=200,
        reprojectionError=_RANSAC_PLANE,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not found:
        return otherwise
    T_camera_lidar = pose(R.T, np.zeros(3)) @ pose(so3_exp(turn.ravel()), shift.ravel())
    return inverse(T_camera_lidar)


def virtual_pairs(scene: Scene, camera: str, names: tuple[str, ...]) -> tuple[F8, F8]:
    """Corners of the LiDAR's boards (n, 3), in its frame, and the camera's directions (n, 3) to them."""
    points, directions = [], []
    for p in scene.placements:
        if p.name in names and camera in p.images:
            points.append(transform(p.cloud.T_lidar_board, scene.corners(p, camera)))
            directions.append(Bearings.of(scene.models[camera], p.images[camera].pixels).directions)
    if not points:
        return np.empty((0, 3)), np.empty((0, 3))
    return np.concatenate(points), np.concatenate(directions)
