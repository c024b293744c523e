"""The graph: a pose per camera, a board per placement, one offset of the ranges; tied by corners and clouds, by GTSAM.

The rows of each cloud (ranges along their rays, edges, squares) were solved before and enter as one factor with their
covariance. Custom factors in Python cost a call each, so that each holds all corners of one image: a graph of 14
placements has some thirty factors and is solved in a tenth of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.factors import cloud_rows, corner_rows, softened
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.rays import Bearings
from scanloom.stages.calibrate.scene import Placement, Scene
from scanloom.stages.geometry.se3 import F8

Rows = Callable[..., tuple[F8, list[F8]]]
CAMERA, BOARD, RANGE, LENS = "c", "b", "o", "k"


@dataclass(frozen=True)
class Estimate:
    """The best calibration of a scene."""

    T_lidar_camera: dict[str, F8]
    T_lidar_board: dict[str, F8]
    """By corners and cloud together, where the boards truly stand."""
    range_offset_m: float
    """How much too long the LiDAR reads."""
    range_offset_sigma_m: float
    models: dict[str, CameraModel]
    """As given, or corrected where intrinsics were free."""
    covariance: F8
    """Of the right tangents of all cameras together, in the order of their names: (6 c, 6 c); scaled."""
    scale: float
    """What the misfit of the clouds put on the standard deviations, 1 at least."""
    misfit: dict[str, F8]
    """By placement: (6,) from the board by the cloud to where it stands, in units of their noise."""

    def camera_covariance(self, camera: str) -> F8:
        i = sorted(self.T_lidar_camera).index(camera)
        return self.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]

    def seen_board(self, T_cloud: F8) -> F8:
        """Where a board truly stands that the LiDAR sees at `T_cloud`."""
        T = T_cloud.copy()
        T[:3, 3] *= 1.0 - self.range_offset_m / np.linalg.norm(T_cloud[:3, 3])
        return T


def solve(scene: Scene, start: Mapping[str, F8], noise: Noise) -> Estimate:
    """Levenberg and Marquardt from a start of the cameras; boards start where the clouds have them.

    Raises
    ------
    RuntimeError : the graph has a direction that nothing fixes (GTSAM's message).
    """
    import gtsam

    graph, values, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), _Keys(scene)
    _add_sensors(graph, values, key, scene, start, noise)
    bearings = scene.bearings()
    for p in scene.placements:
        values.insert(key.board(p.name), gtsam.Pose3(p.cloud.T_lidar_board))
        graph.add(_cloud_factor(key, p, noise))
        for camera in p.images:
            graph.add(_corner_factor(key, scene, p, camera, bearings[p.name, camera], noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(200)
    parameters.setRelativeErrorTol(1e-9)
    parameters.setAbsoluteErrorTol(1e-9)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return _estimate(graph, solved, key, scene, noise)


class _Keys:
    """Numbers of the variables."""

    def __init__(self, scene: Scene) -> None:
        self._cameras = {name: i for i, name in enumerate(scene.cameras)}
        self._placements = {name: i for i, name in enumerate(scene.names)}
        self.range = _symbol(RANGE, 0)

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
    graph: Any, values: Any, key: _Keys, scene: Scene, start: Mapping[str, F8], noise: Noise
) -> None:
    """Cameras, their lenses where these are free, and the LiDAR's offset."""
    import gtsam

    def vector(number: int, sigma: F8) -> None:
        values.insert(number, np.zeros(len(sigma)))
        prior = gtsam.noiseModel.Diagonal.Sigmas(sigma)
        graph.add(gtsam.PriorFactorVector(number, np.zeros(len(sigma)), prior))

    vector(key.range, np.array([noise.range_prior_m]))
    for camera in scene.cameras:
        values.insert(key.camera(camera), gtsam.Pose3(start[camera]))
        if noise.lens_share > 0:
            vector(key.lens(camera), np.full(4, noise.lens_share * scene.models[camera].fx_px))


def _cloud_factor(key: _Keys, p: Placement, noise: Noise) -> Any:
    whiten = whitener(p, noise)

    def rows(T_lidar_board: F8, far: F8) -> tuple[F8, list[F8]]:
        error, by_board, by_far = cloud_rows(T_lidar_board, p.cloud.T_lidar_board, float(far[0]))
        return whiten @ error, [whiten @ by_board, whiten @ by_far]

    return _factor([key.board(p.name), key.range], 6, rows)


def whitener(p: Placement, noise: Noise) -> F8:
    """(6, 6) that makes the misfit of a cloud's board a vector of unit variances."""
    covariance = p.cloud.covariance + noise.bias_covariance
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)


def _corner_factor(key: _Keys, scene: Scene, p: Placement, camera: str, seen: Bearings, noise: Noise) -> Any:
    corners = scene.corners(p, camera)
    sigma = max(p.images[camera].sigma_px, noise.corner_least_px)
    keys = [key.camera(camera), key.board(p.name)]
    if noise.lens_share > 0:
        keys.append(key.lens(camera))

    def rows(T_lidar_camera: F8, T_lidar_board: F8, lens: F8 | None = None) -> tuple[F8, list[F8]]:
        error, by_camera, by_board = corner_rows(T_lidar_camera, T_lidar_board, corners, seen)
        slopes = [by_camera, by_board]
        if lens is not None:
            error = error + seen.by_intrinsics @ lens
            slopes.append(seen.by_intrinsics)
        by_error, by_slope = softened(error / sigma, noise.softness)
        weighed = [(J / sigma * by_slope[:, :, None]).reshape(-1, J.shape[2]) for J in slopes]
        return (error / sigma * by_error).ravel(), weighed

    return _factor(keys, 2 * len(corners), rows)


def _factor(keys: list[int], size: int, rows: Rows) -> Any:
    """A factor of GTSAM whose rows are already in units of their noise."""
    import gtsam

    vectors = [chr(gtsam.symbolChr(k)) in (LENS, RANGE) for k in keys]

    def error(this: Any, values: Any, jacobians: list[F8] | None) -> F8:
        states = [values.atVector(k) if v else values.atPose3(k).matrix() for k, v in zip(this.keys(), vectors)]
        e, slopes = rows(*states)
        if jacobians is not None:
            for i, J in enumerate(slopes):
                jacobians[i] = J
        return e

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), keys, error)


def _estimate(graph: Any, solved: Any, key: _Keys, scene: Scene, noise: Noise) -> Estimate:
    import gtsam

    cameras = {c: np.asarray(solved.atPose3(key.camera(c)).matrix()) for c in scene.cameras}
    boards = {name: np.asarray(solved.atPose3(key.board(name)).matrix()) for name in scene.names}
    far = float(solved.atVector(key.range)[0])
    marginals = gtsam.Marginals(graph, solved)
    keys = gtsam.KeyVector([key.camera(c) for c in scene.cameras])
    covariance = np.asarray(marginals.jointMarginalCovariance(keys).fullMatrix())
    misfit = {
        p.name: whitener(p, noise) @ cloud_rows(boards[p.name], p.cloud.T_lidar_board, far)[0]
        for p in scene.placements
    }
    freedom = max(6 * len(misfit) - 6 * len(cameras) - 1, len(misfit))
    scale = max(1.0, float(np.sqrt(sum(e @ e for e in misfit.values()) / freedom)))
    models = dict(scene.models)
    if noise.lens_share > 0:
        models = {c: corrected(m, solved.atVector(key.lens(c))) for c, m in models.items()}
    return Estimate(
        T_lidar_camera=cameras,
        T_lidar_board=boards,
        range_offset_m=far,
        range_offset_sigma_m=float(np.sqrt(marginals.marginalCovariance(key.range)[0, 0])) * scale,
        models=models,
        covariance=covariance * scale**2,
        scale=scale,
        misfit=misfit,
    )


def corrected(model: CameraModel, shift: F8) -> CameraModel:
    """A model with its fx, fy, cx, cy moved by `shift` (4,), px."""
    fields = ("fx_px", "fy_px", "cx_px", "cy_px")
    return model.model_copy(update={f: getattr(model, f) + float(d) for f, d in zip(fields, shift)})
