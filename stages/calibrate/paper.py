"""The method as published (Ou et al. 2022): free corner points in the LiDAR's frame, tied by reprojection alone.

Kept for comparison. With nothing to hold the points, they follow the images and leave the cameras where EPnP put them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanloom.stages.calibrate.graph import CAMERA, Estimate
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.rays import facing
from scanloom.stages.calibrate.scene import Scene
from scanloom.stages.calibrate.start import epnp
from scanloom.stages.calibrate.view import Sensor
from scanloom.stages.geometry.se3 import F8, inverse, pose, transform

POINT = "p"
_CLOUD_SIGMA_M = 0.01
"""Of a free point by the cloud, for the covariance: the published objective has none."""


def solve_paper(scene: Scene, start: Mapping[str, F8], noise: Noise) -> Estimate:
    """EPnP, then points and cameras by GTSAM's own projection factors on each camera's normalised plane."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    lens, unit = gtsam.Cal3_S2(), gtsam.noiseModel.Isotropic.Sigma(2, 1e-3)
    corners = scene.board.corners_m()
    bearings = scene.bearings()
    planes = _planes(scene)
    poses = {}
    for i, camera in enumerate(scene.cameras):
        names = tuple(p.name for p in scene.seen_by(camera))
        poses[camera] = epnp(scene, camera, names, start[camera])
        T_turn = pose(planes[camera].T, np.zeros(3))
        values.insert(gtsam.symbol(CAMERA, i), gtsam.Pose3(poses[camera] @ T_turn))
    for k, p in enumerate(scene.placements):
        there = transform(p.cloud.T_lidar_board, corners)
        for i, camera in enumerate(scene.cameras):
            if camera not in p.images:
                continue
            turned = bearings[p.name, camera].directions @ planes[camera].T
            for j, ray in zip(p.images[camera].index, turned):
                point = gtsam.symbol(POINT, k * len(corners) + int(j))
                if not values.exists(point):
                    values.insert(point, there[j])
                if ray[2] > 0.1:
                    key = gtsam.symbol(CAMERA, i)
                    graph.add(gtsam.GenericProjectionFactorCal3_S2(ray[:2] / ray[2], unit, key, point, lens))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = {
        camera: np.asarray(solved.atPose3(gtsam.symbol(CAMERA, i)).matrix())
        @ pose(planes[camera], np.zeros(3))
        for i, camera in enumerate(scene.cameras)
    }
    return _estimate(scene, found)


def _planes(scene: Scene) -> dict[str, F8]:
    """Rotation that turns the middle of all a camera's corners onto the optical axis of its normalised plane."""
    bearings = scene.bearings()
    return {
        camera: facing(np.concatenate([bearings[p.name, camera].directions for p in scene.seen_by(camera)]))
        for camera in scene.cameras
    }


def _estimate(scene: Scene, poses: dict[str, F8]) -> Estimate:
    """Covariance as if each of the points were known to a centimetre: the objective itself says nothing of it."""
    blocks = np.zeros((6 * len(poses), 6 * len(poses)))
    for i, camera in enumerate(scene.cameras):
        points = np.concatenate([_in_camera(scene, p.name, poses[camera]) for p in scene.seen_by(camera)])
        J = np.concatenate((_hats(points), np.broadcast_to(-np.eye(3), (len(points), 3, 3))), axis=2).reshape(
            -1, 6
        )
        blocks[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = np.linalg.inv(J.T @ J) * _CLOUD_SIGMA_M**2
    boards = {p.name: p.cloud.T_lidar_board for p in scene.placements}
    believed = Sensor.unknown(scene.beams, Noise().believing())
    return Estimate(poses, boards, believed, dict(scene.models), blocks, 1.0, {})


def _in_camera(scene: Scene, name: str, T_lidar_camera: F8) -> F8:
    T = next(p.cloud.T_lidar_board for p in scene.placements if p.name == name)
    return transform(inverse(T_lidar_camera) @ T, scene.board.outline_m())


def _hats(points: F8) -> F8:
    from scanloom.stages.geometry.se3 import hat

    return hat(points)
