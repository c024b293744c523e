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
from scanloom.stages.calibrate.scene import Scene
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
    """(6, 6) of their difference in the board's frame, without bias."""


@dataclass(frozen=True)
class Agreement:
    """All cameras by whole boards."""

    T_lidar_camera: dict[str, F8]
    range_offset_m: float
    covariance: F8
    """(6 c + 1, 6 c + 1): tangents of the cameras in the order of their names, then the offset."""


def pairs_of(scene: Scene, noise: Noise) -> list[Pair]:
    """All boards that a camera saw."""
    found = []
    for (name, camera), bearings in scene.bearings().items():
        p = next(p for p in scene.placements if p.name == name)
        seen = p.images[camera]
        sigma = max(seen.sigma_px, noise.corner_least_px)
        image = _by_corners(bearings, scene.corners(p, camera), seen.T_camera_board, sigma)
        T_lidar_board = p.cloud.T_lidar_board
        found.append(Pair(name, camera, T_lidar_board, seen.T_camera_board, p.cloud.covariance + image))
    return found


def _by_corners(bearings: Bearings, corners: F8, T_camera_board: F8, sigma_px: float) -> F8:
    """Covariance (6, 6) of the right tangent of a board by its corners (n, 3) in one image."""
    _, slopes = bearings.errors(transform(T_camera_board, corners))
    R = T_camera_board[:3, :3]
    turn, shift = -R @ hat(corners), np.broadcast_to(R, (len(corners), 3, 3))
    J = (slopes @ np.concatenate((turn, shift), axis=2)).reshape(-1, 6) / sigma_px
    return np.asarray(np.linalg.inv(J.T @ J))


def misfit(pair: Pair, T_lidar_camera: F8, range_offset_m: float) -> F8:
    """(6,) from the board by the cloud to that by the camera: turn, rad, and shift, m, in its frame."""
    return cloud_rows(T_lidar_camera @ pair.T_camera_board, pair.T_lidar_board, range_offset_m)[0]


def agree(found: Sequence[Pair], start: Mapping[str, F8], noise: Noise) -> Agreement:
    """Iterated weighted least squares; pairs far off hardly count (Geman and McClure), less and less as it goes on."""
    cameras = sorted({pair.camera for pair in found})
    poses, far = {c: start[c] for c in cameras}, 0.0
    weights = [np.linalg.inv(pair.covariance + noise.bias_covariance) for pair in found]
    H = np.eye(6 * len(cameras) + 1)
    for strictness in _STRICTER:
        for _ in range(_ROUNDS):
            H, g = _normal(found, weights, poses, far, noise, (strictness * _ROBUST_SIGMAS) ** 2)
            step = -np.linalg.solve(H, g)
            for i, camera in enumerate(cameras):
                poses[camera] = poses[camera] @ se3_exp(step[6 * i : 6 * i + 6])
            far += float(step[-1])
            if np.abs(step).max() < _SMALL:
                break
    return Agreement(poses, far, np.asarray(np.linalg.inv(H)))


def _normal(
    found: Sequence[Pair], weights: Sequence[F8], poses: Mapping[str, F8], far: float, noise: Noise, limit: float
) -> tuple[F8, F8]:
    """Equations of one step; `limit` is the square beyond which a pair loses its weight."""
    cameras = sorted(poses)
    size = 6 * len(cameras) + 1
    H, g = np.zeros((size, size)), np.zeros(size)
    H[-1, -1], g[-1] = 1 / noise.range_prior_m**2, far / noise.range_prior_m**2
    for pair, W in zip(found, weights):
        at = 6 * cameras.index(pair.camera)
        error, J = _slopes(pair, poses[pair.camera], far)
        trust = (limit / (limit + error @ W @ error / 6)) ** 2
        columns = np.r_[at : at + 6, size - 1]
        H[np.ix_(columns, columns)] += trust * J.T @ W @ J
        g[columns] += trust * J.T @ W @ error
    return H, g


def _slopes(pair: Pair, T_lidar_camera: F8, far: float) -> tuple[F8, F8]:
    """Misfit (6,) and its derivative (6, 7) by the camera's tangent and the offset."""
    error, by_board, by_far = cloud_rows(T_lidar_camera @ pair.T_camera_board, pair.T_lidar_board, far)
    return error, np.concatenate((by_board @ adjoint(inverse(pair.T_camera_board)), by_far), axis=1)


@dataclass(frozen=True)
class Stranger:
    """A board that does not fit what the others say."""

    pair: Pair
    misfit: F8
    square: float
    """Chi-square over its freedom, in units of what the others have."""


def strangers(found: Sequence[Pair], start: Mapping[str, F8], noise: Noise, limit: float) -> list[Stranger]:
    """Pairs that do not fit, worst first, each judged by a calibration without its placement.

    In units of what the others scatter by (their median). A camera keeps three pairs at least.
    """
    kept, out = list(found), []
    while True:
        judged = _judged(kept, start, noise)
        if not judged:
            return out
        usual = max(1.0, float(np.median([s.square for s in judged])) / _MEDIAN)
        open_to_doubt = [s for s in judged if sum(p.camera == s.pair.camera for p in kept) > 3]
        worst = max(open_to_doubt, key=lambda s: s.square, default=None)
        if worst is None or worst.square / usual < limit:
            return out
        out.append(Stranger(worst.pair, worst.misfit, worst.square / usual))
        kept.remove(worst.pair)


def _judged(kept: Sequence[Pair], start: Mapping[str, F8], noise: Noise) -> list[Stranger]:
    found = []
    for name in sorted({pair.placement for pair in kept}):
        others = [pair for pair in kept if pair.placement != name]
        known = agree(others, start, noise) if others else None
        for pair in kept:
            if pair.placement == name and known and pair.camera in known.T_lidar_camera:
                found.append(_against(pair, known, noise))
    return found


def _against(pair: Pair, known: Agreement, noise: Noise) -> Stranger:
    error, J = _slopes(pair, known.T_lidar_camera[pair.camera], known.range_offset_m)
    at = 6 * sorted(known.T_lidar_camera).index(pair.camera)
    columns = np.r_[at : at + 6, len(known.covariance) - 1]
    S = pair.covariance + noise.bias_covariance + J @ known.covariance[np.ix_(columns, columns)] @ J.T
    return Stranger(pair, error, float(error @ np.linalg.solve(S, error) / 6))


def scattered(found: Sequence[Pair], known: Agreement, noise: Noise) -> Noise:
    """The noise with the bias of whole boards that their misfits ask for.

    In each of four directions (tilt, turn, on the plane, along the normal): the mean square of the misfits, freedom
    counted, less what the noise of points and corners explains.
    """
    errors = np.array([misfit(p, known.T_lidar_camera[p.camera], known.range_offset_m) for p in found])
    formal = np.array([np.diag(pair.covariance) for pair in found])
    freedom = max(1.0 - len(known.T_lidar_camera) / len(found), 0.25)
    excess = np.maximum(np.mean(errors**2, axis=0) / freedom - np.mean(formal, axis=0), 0.0)
    tilt, spin, plane, normal = excess[:2].mean(), excess[2], excess[3:5].mean(), excess[5]
    return noise.with_bias(*(float(np.sqrt(value)) for value in (tilt, spin, plane, normal)))
