"""The graph: a pose per camera, a board per placement, the errors of the LiDAR; tied by corners and clouds, by GTSAM.

The rows of each cloud (ranges along their rays, edges, squares) enter as one factor, triangular and so as small as it
can be. Custom factors in Python cost a call each, so that each holds all corners of one image: a graph of 14
placements has some thirty factors and is solved in a tenth of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.factors import corner_rows, softened
from scanloom.stages.calibrate.lens import by_intrinsics, corrected, prior_sigmas
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.rays import Bearings
from scanloom.stages.calibrate.scene import Placement, Scene
from scanloom.stages.calibrate.view import Rows, Sensor, rows_of
from scanloom.stages.geometry.se3 import F8

Residual = Callable[..., tuple[F8, list[F8]]]
CAMERA, BOARD, SENSOR, LENS = "c", "b", "s", "k"


@dataclass(frozen=True)
class Estimate:
    """The best calibration of a scene."""

    T_lidar_camera: dict[str, F8]
    T_lidar_board: dict[str, F8]
    """By corners and cloud together, where the boards truly stand."""
    sensor: Sensor
    """What the LiDAR is off by."""
    models: dict[str, CameraModel]
    """As given, or corrected where intrinsics were free."""
    covariance: F8
    """Of the right tangents of all cameras together, in the order of their names: (6 c, 6 c); scaled."""
    scale: float
    """What the misfit of the clouds put on the standard deviations, 1 at least."""
    rows: dict[str, Rows]
    """By placement: what its cloud says, as the graph has it."""

    def camera_covariance(self, camera: str) -> F8:
        i = sorted(self.T_lidar_camera).index(camera)
        return self.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]

    def board_by_cloud(self, p: Placement, noise: Noise) -> F8:
        """Where the LiDAR alone has a board, corrected by what it is off."""
        return rows_of(p.cloud, self.sensor, noise).board(self.sensor)[0]


def solve(scene: Scene, start: Mapping[str, F8], noise: Noise) -> Estimate:
    """Levenberg and Marquardt from a start of the cameras; boards start where the clouds have them.

    Raises
    ------
    RuntimeError : the graph has a direction that nothing fixes (GTSAM's message).
    """
    import gtsam

    graph, values, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), _Keys(scene)
    sensor = Sensor.unknown(scene.beams, noise)
    rows = {p.name: rows_of(p.cloud, sensor, noise) for p in scene.placements}
    _add_sensors(graph, values, key, scene, start, sensor, noise)
    bearings = scene.bearings()
    for p in scene.placements:
        values.insert(key.board(p.name), gtsam.Pose3(p.cloud.T_lidar_board))
        graph.add(_cloud_factor(key, p.name, rows[p.name]))
        for camera in p.images:
            graph.add(_corner_factor(key, scene, p, camera, bearings[p.name, camera], noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(200)
    parameters.setRelativeErrorTol(1e-9)
    parameters.setAbsoluteErrorTol(1e-9)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return _estimate(graph, solved, key, scene, rows, noise)


class _Keys:
    """Numbers of the variables."""

    def __init__(self, scene: Scene) -> None:
        self._cameras = {name: i for i, name in enumerate(scene.cameras)}
        self._placements = {name: i for i, name in enumerate(scene.names)}
        self.sensor = _symbol(SENSOR, 0)

    def camera(self, name: str) -> int:
        return _symbol(CAMERA, self._cameras[name])

    def lens(self, name: str) -> int:
        return _symbol(LENS, self._cameras[name])

    def board(self, name: str) -> int:
        return _symbol(BOARD, self._placements[name])


def _symbol(letter: str, number: int) -> int:
    import gtsam

    return int(gtsam.symbol(letter, number))


def _add_sensors(
    graph: Any, values: Any, key: _Keys, scene: Scene, start: Mapping[str, F8], sensor: Sensor, noise: Noise
) -> None:
    """Cameras, their lenses where these are free, and what the LiDAR is off by."""
    import gtsam

    def vector(number: int, covariance: F8) -> None:
        zero = np.zeros(len(covariance))
        values.insert(number, zero)
        graph.add(gtsam.PriorFactorVector(number, zero, gtsam.noiseModel.Gaussian.Covariance(covariance)))

    vector(key.sensor, sensor.covariance)
    for camera in scene.cameras:
        values.insert(key.camera(camera), gtsam.Pose3(start[camera]))
        if noise.lens_free:
            sigmas = prior_sigmas(scene.models[camera], noise.lens_share, noise.lens_bend_px)
            vector(key.lens(camera), np.diag(sigmas**2))


def _cloud_factor(key: _Keys, name: str, cloud: Rows) -> Any:
    def rows(T_lidar_board: F8, sensor: F8) -> tuple[F8, list[F8]]:
        error, slopes = cloud.at(T_lidar_board, sensor)
        return error, [slopes, cloud.by_sensor]

    return _factor([key.board(name), key.sensor], len(cloud.gap), rows)


def _corner_factor(key: _Keys, scene: Scene, p: Placement, camera: str, seen: Bearings, noise: Noise) -> Any:
    corners = scene.corners(p, camera)
    sigma = max(p.images[camera].sigma_px, noise.corner_least_px)
    keys = [key.camera(camera), key.board(p.name)]
    if noise.lens_free:
        keys.append(key.lens(camera))
    moves = by_intrinsics(scene.models[camera], seen.directions) if noise.lens_free else None

    def rows(T_lidar_camera: F8, T_lidar_board: F8, lens: F8 | None = None) -> tuple[F8, list[F8]]:
        error, by_camera, by_board = corner_rows(T_lidar_camera, T_lidar_board, corners, seen)
        slopes = [by_camera, by_board]
        if lens is not None and moves is not None:
            error = error + moves @ lens
            slopes.append(moves)
        by_error, by_slope = softened(error / sigma, noise.softness)
        weighed = [(J / sigma * by_slope[:, :, None]).reshape(-1, J.shape[2]) for J in slopes]
        return (error / sigma * by_error).ravel(), weighed

    return _factor(keys, 2 * len(corners), rows)


def _factor(keys: list[int], size: int, rows: Residual) -> Any:
    """A factor of GTSAM whose rows are already in units of their noise."""
    import gtsam

    vectors = [chr(gtsam.symbolChr(k)) in (LENS, SENSOR) for k in keys]

    def error(this: Any, values: Any, jacobians: list[F8] | None) -> F8:
        states = [
            values.atVector(k) if v else values.atPose3(k).matrix() for k, v in zip(this.keys(), vectors)
        ]
        e, slopes = rows(*states)
        if jacobians is not None:
            for i, J in enumerate(slopes):
                jacobians[i] = J
        return e

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), keys, error)


def _estimate(
    graph: Any, solved: Any, key: _Keys, scene: Scene, rows: dict[str, Rows], noise: Noise
) -> Estimate:
    import gtsam

    cameras = {c: np.asarray(solved.atPose3(key.camera(c)).matrix()) for c in scene.cameras}
    boards = {name: np.asarray(solved.atPose3(key.board(name)).matrix()) for name in scene.names}
    marginals = gtsam.Marginals(graph, solved)
    keys = gtsam.KeyVector([key.camera(c) for c in scene.cameras])
    covariance = np.asarray(marginals.jointMarginalCovariance(keys).fullMatrix())
    mean = np.asarray(solved.atVector(key.sensor))
    sensor = Sensor(scene.beams, mean, np.asarray(marginals.marginalCovariance(key.sensor)))
    scale = _scale([rows[name].at(T, mean)[0] for name, T in boards.items()], len(cameras))
    models = dict(scene.models)
    if noise.lens_free:
        models = {c: corrected(m, solved.atVector(key.lens(c))) for c, m in models.items()}
    return Estimate(cameras, boards, sensor, models, covariance * scale**2, scale, rows)


def _scale(errors: Sequence[F8], cameras: int) -> float:
    """By how much the clouds miss the boards, in units of their noise; boards that the images hold take no freedom."""
    freedom = sum(len(e) for e in errors) - 6 * cameras
    return max(1.0, float(np.sqrt(sum(e @ e for e in errors) / max(freedom, 6))))
