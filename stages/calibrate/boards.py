"""The calibration by whole boards: a board by the cloud and the same board by an image are two poses that must meet.

Six numbers a board instead of hundreds of rows, so that leaving out each placement in turn costs milliseconds: this
finds what does not fit, and how far whole boards are off beyond the noise of their points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.stages.calibrate.factors import cloud_rows
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.rays import Bearings
from scanloom.stages.calibrate.scene import Placement, Scene
from scanloom.stages.calibrate.view import Sensor, beam_gaps, rows_of
from scanloom.stages.geometry.se3 import F8, adjoint, hat, inverse, se3_exp, transform

_ROUNDS = 30
_MEDIAN = 0.8914
"""Of chi-square with six degrees of freedom over six."""
_STRICTER = (1e3, 100.0, 30.0, 10.0, 3.0, 1.0)
_ROBUST_SIGMAS = 3.0
_SMALL = 1e-9


@dataclass(frozen=True)
class Pair:
    """One board by the cloud and by one camera's image."""

    placement: str
    camera: str
    T_lidar_board: F8
    T_camera_board: F8
    covariance: F8
    """(6, 6) of their difference in the board's frame."""


@dataclass(frozen=True)
class Agreement:
    """All cameras by whole boards, each for itself."""

    T_lidar_camera: dict[str, F8]
    covariance: dict[str, F8]


def pairs_of(scene: Scene, noise: Noise, sensor: Sensor | None = None) -> list[Pair]:
    """All boards that a camera saw, with what is known of the LiDAR; nothing unless it is told."""
    known = sensor or Sensor.unknown(scene.beams, noise)
    bearings = scene.bearings()
    found = []
    for p in scene.placements:
        T_lidar_board, cloud = rows_of(p.cloud, known, noise).board(known)
        for camera, seen in p.images.items():
            image = _by_corners(
                bearings[p.name, camera], scene.corners(p, camera), seen.T_camera_board, seen.sigma_px, noise
            )
            found.append(Pair(p.name, camera, T_lidar_board, seen.T_camera_board, cloud + image))
    return found


def _by_corners(bearings: Bearings, corners: F8, T_camera_board: F8, sigma_px: float, noise: Noise) -> F8:
    """Covariance (6, 6) of the right tangent of a board by its corners (n, 3) in one image."""
    _, slopes = bearings.errors(transform(T_camera_board, corners))
    R = T_camera_board[:3, :3]
    turn, shift = -R @ hat(corners), np.broadcast_to(R, (len(corners), 3, 3))
    J = (slopes @ np.concatenate((turn, shift), axis=2)).reshape(-1, 6) / max(sigma_px, noise.corner_least_px)
    return np.asarray(np.linalg.inv(J.T @ J))


def misfit(pair: Pair, T_lidar_camera: F8) -> F8:
    """(6,) from the board by the cloud to that by the camera: turn, rad, and shift, m, in its frame."""
    return cloud_rows(T_lidar_camera @ pair.T_camera_board, pair.T_lidar_board)[0]


def agree(found: Sequence[Pair], start: Mapping[str, F8]) -> Agreement:
    """Iterated weighted least squares; pairs far off hardly count (Geman and McClure), less and less as it goes on."""
    poses, covariance = {}, {}
    for camera in sorted({pair.camera for pair in found}):
        mine = [pair for pair in found if pair.camera == camera]
        poses[camera], covariance[camera] = _agree(mine, start[camera])
    return Agreement(poses, covariance)


def _agree(found: Sequence[Pair], T: F8) -> tuple[F8, F8]:
    weights = [np.linalg.inv(pair.covariance) for pair in found]
    H = np.eye(6)
    for strictness in _STRICTER:
        limit = (strictness * _ROBUST_SIGMAS) ** 2
        for _ in range(_ROUNDS):
            H, g = np.zeros((6, 6)), np.zeros(6)
            for pair, W in zip(found, weights):
                error, J = _slopes(pair, T)
                trust = (limit / (limit + error @ W @ error / 6)) ** 2
                H += trust * J.T @ W @ J
                g += trust * J.T @ W @ error
            step = -np.linalg.solve(H, g)
            T = T @ se3_exp(step)
            if np.abs(step).max() < _SMALL:
                break
    return T, np.asarray(np.linalg.inv(H))


def _slopes(pair: Pair, T_lidar_camera: F8) -> tuple[F8, F8]:
    """Misfit (6,) and its derivative (6, 6) by the camera's tangent."""
    error, by_board = cloud_rows(T_lidar_camera @ pair.T_camera_board, pair.T_lidar_board)
    return error, by_board @ adjoint(inverse(pair.T_camera_board))


@dataclass(frozen=True)
class Stranger:
    """A board that does not fit what the others say."""

    pair: Pair
    misfit: F8
    square: float
    """Chi-square over its freedom, in units of what the others have."""


def strangers(found: Sequence[Pair], start: Mapping[str, F8], limit: float) -> list[Stranger]:
    """Pairs that do not fit, worst first, each judged by a calibration of its camera without it.

    In units of what the others scatter by (their median). Of three that do not agree one goes, and two are too few to go on with.
    """
    kept = list(found)
    out: list[Stranger] = []
    while True:
        judged = [s for i in range(len(kept)) if (s := _judged(kept, i, start)) is not None]
        if not judged:
            return out
        usual = max(1.0, float(np.median([s.square for s in judged])) / _MEDIAN)
        worst = max(judged, key=lambda s: s.square)
        if worst.square / usual < limit:
            return out
        out.append(Stranger(worst.pair, worst.misfit, worst.square / usual))
        kept.remove(worst.pair)


def _judged(kept: Sequence[Pair], i: int, start: Mapping[str, F8]) -> Stranger | None:
    pair = kept[i]
    others = [other for j, other in enumerate(kept) if j != i and other.camera == pair.camera]
    if len(others) < 2:
        return None
    T, covariance = _agree(others, start[pair.camera])
    error, J = _slopes(pair, T)
    S = pair.covariance + J @ covariance @ J.T
    return Stranger(pair, error, float(error @ np.linalg.solve(S, error) / 6))


def scattered(scene: Scene, noise: Noise, poses: Mapping[str, F8], sensor: Sensor) -> Noise:
    """The noise with the errors of whole boards, and of beams within a placement, that their misfits ask for.

    In each of four directions (tilt, turn, on the plane, along the normal): the mean square of the misfits, freedom
    counted, less what the noise of points, beams and corners explains.
    """
    beam_m = _beam_scatter(scene, poses, sensor)
    plain = noise.with_bias((0.0, 0.0, 0.0, 0.0), beam_m)
    found = pairs_of(scene, plain, sensor)
    errors = np.array([misfit(p, poses[p.camera]) for p in found])
    formal = np.array([np.diag(pair.covariance) for pair in found])
    freedom = max(1.0 - len(poses) / len(found), 0.25)
    excess = np.maximum(np.mean(errors**2, axis=0) / freedom - np.mean(formal, axis=0), 0.0)
    tilt, spin, plane, normal = np.sqrt((excess[:2].mean(), excess[2], excess[3:5].mean(), excess[5]))
    return noise.with_bias((float(tilt), float(spin), float(plane), float(normal)), beam_m)


def _beam_scatter(scene: Scene, poses: Mapping[str, F8], sensor: Sensor) -> float:
    """How much offsets of beams differ between placements, m, the mean of each placement apart."""
    squares, formal = [], []
    for p in scene.placements:
        gaps, variance = beam_gaps(p.cloud, _board(p, poses), sensor)
        if len(gaps) > 2:
            squares.append((gaps - gaps.mean()) ** 2 * len(gaps) / (len(gaps) - 1))
            formal.append(variance)
    if not squares:
        return 0.0
    all_squares = np.concatenate(squares)
    limited = np.minimum(all_squares, _FAR_SQUARE * np.median(all_squares))
    return float(np.sqrt(max(np.mean(limited) - np.mean(np.concatenate(formal)), 0.0)))


_FAR_SQUARE = 20.0
"""Times the median: three standard deviations."""


def _board(p: Placement, poses: Mapping[str, F8]) -> F8:
    """The board by the image that scatters least."""
    camera = min(p.images, key=lambda c: p.images[c].sigma_px)
    return poses[camera] @ p.images[camera].T_camera_board
