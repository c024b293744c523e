"""How far a registration can be trusted, direction by direction (methods 1.7 and 1.8).

Rotation and translation have different units. All eigen-directions are therefore those of H in the scaled tangent
y = (r * rotation, translation), with r the root mean square range of the matched points: both parts are metres then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.registration import Registration
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxel_map import I8
from scanloom.stages.geometry.voxels import Float

SNR = 10.0
POINT_NOISE_M = 0.02
BLIND_STD_M = 10.0
EIGENVALUE_FLOOR = 1e-9
LEAST_POINTS = 6
PATCH_RAD = (np.radians(30.0), np.radians(2.5))
"""Azimuth and elevation of a patch of the view: a few beams, and a stretch of one surface."""
INDEPENDENT_SHARE = 0.1


@dataclass(frozen=True)
class Degeneracy:
    """What a registration saw.

    Attributes
    ----------
    d : D, smallest eigenvalue of the Schur complement H_tt - H_tr H_rr^-1 H_rt, per unit weight (0 blind, 1/3 best).
    e_m : E in the form asked for, see `indicator`, m.
    p : (6,) probability that each direction is observed beyond noise (DRPM, arXiv 2410.10784), weakest first.
    directions : (6, 6) eigenvectors as columns in the scaled tangent, weakest first.
    eigenvalues : (6,) of the scaled information, increasing.
    range_m : r, the scale of rotation.
    scatter : (6, 6) covariance of the gradient at the solution, along `directions`, m2: see `judge`.
    """

    d: float
    e_m: float
    p: F8
    directions: F8
    eigenvalues: F8
    range_m: float
    scatter: F8

    @property
    def scale(self) -> F8:
        """(6,) factors s with xi = s * y."""
        return _scale(self.range_m)

    def observed(self, least_p: float) -> F8:
        """Directions (6, k) with p of at least `least_p`, as columns in the unscaled tangent."""
        return self.scale[:, None] * self.directions[:, self.p >= least_p]

    def scan_information(self, least_p: float, inflation: float = 1.0) -> F8:
        """R^-1 (6, 6) of the registered pose along the observed directions, nothing along the rest; right tangent.

        R = inflation * H^-1 B H^-1 with the scatter B of the gradient: sigma2 H^-1 where residuals are independent.
        """
        observed = self.p >= least_p
        eigenvalues = np.maximum(self.eigenvalues[observed], EIGENVALUE_FLOOR)
        spread = inflation * self.scatter[np.ix_(observed, observed)]
        inside = eigenvalues[:, None] * np.linalg.pinv(spread, hermitian=True) * eigenvalues
        outward = (self.directions / self.scale[:, None])[:, observed]
        information: F8 = outward @ inside @ outward.T
        return 0.5 * (information + information.T)


def blind() -> Degeneracy:
    """A scan that saw nothing."""
    return Degeneracy(0.0, BLIND_STD_M, np.zeros(6), np.eye(6), np.zeros(6), 1.0, np.zeros((6, 6)))


Indicator = Literal["E1", "E2", "E3"]
INDICATORS: tuple[Indicator, ...] = get_args(Indicator)


def indicator(registration: Registration, kind: Indicator = "E1") -> float:
    """E of a registration, m; the larger, the worse; `BLIND_STD_M` at most (methods 1.7).

    E1 : sqrt(lambda_max([sigma2 H^-1]_tt)), worst standard deviation of translation: geometry times residual.
    E2 : rmse / inlier ratio: pure error of matching.
    E3 : E1 / inlier ratio. What found no partner lies in free or unknown space of the map; its share stands in for one
        counted in an occupancy grid, which the local map is not.
    """
    value = float("inf")
    share = registration.inlier_ratio
    if kind == "E2":
        value = registration.rmse_m / share if share > 0 else value
    elif len(registration.points) >= LEAST_POINTS:
        value = _worst_translation(registration.information, registration.sigma2)
        if kind == "E3":
            value = value / share if share > 0 else BLIND_STD_M
    return min(value, BLIND_STD_M)


def translation_information(registration: Registration) -> float:
    """D: smallest eigenvalue of the Schur complement H_tt - H_tr H_rr^-1 H_rt, per unit weight (0 blind, 1/3 best)."""
    return _translation_information(registration.information) / max(
        float(registration.weights.sum()), EIGENVALUE_FLOOR
    )


def judge(
    registration: Registration,
    *,
    point_noise_m: float = POINT_NOISE_M,
    snr: float = SNR,
    kind: Indicator = "E1",
) -> Degeneracy:
    """D, E and the probabilities p of a registration.

    p_k = Phi((lambda_k / (1 + SNR) - mean_k) / std_k), where mean and std are those of the information that noise of
    points (`point_noise_m`) and of fitted normals alone would give along direction k.

    The scatter is sum_c g_c g_c^T over patches c of the view with g_c = sum w J^T e: residuals of a patch share surfaces
    of the map and beams that point a little wrong, and are no independent measurements (cluster-robust covariance:
    Liang and Zeger, Biometrika 73, 1986). A little of sigma2 H is added, for patches whose residuals vanish by chance.
    """
    if len(registration.points) < LEAST_POINTS:
        return blind()
    range_m = float(np.sqrt((registration.points**2).sum(axis=1).mean()))
    scale = _scale(range_m)
    H = registration.information * scale[:, None] * scale
    eigenvalues, directions = np.linalg.eigh(H)
    mean, variance = np.zeros(6), np.zeros(6)
    _noise_information(
        registration.points, registration.normals, registration.weights, registration.normal_variance,
        scale[:, None] * directions, point_noise_m**2, mean, variance,
    )  # fmt: skip
    p = _normal_cdf((eigenvalues / (1 + snr) - mean) / np.sqrt(np.maximum(variance, EIGENVALUE_FLOOR)))
    return Degeneracy(
        d=translation_information(registration),
        e_m=indicator(registration, kind),
        p=p,
        directions=directions,
        eigenvalues=np.maximum(eigenvalues, 0.0),
        range_m=range_m,
        scatter=_scatter(registration, scale[:, None] * directions, eigenvalues),
    )


def _scale(range_m: float) -> F8:
    return np.array([1 / range_m] * 3 + [1.0] * 3)


def _scatter(registration: Registration, outward: F8, eigenvalues: F8) -> F8:
    points = registration.points
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    row = np.floor((elevation + 0.5 * np.pi) / PATCH_RAD[1]).astype(np.int64)
    column = np.floor((azimuth + np.pi) / PATCH_RAD[0]).astype(np.int64)
    columns = int(np.ceil(2 * np.pi / PATCH_RAD[0])) + 1
    patch = row * columns + column
    weighted = registration.weights * registration.residuals
    gradients = np.zeros((int(patch.max()) + 1, 6))
    _add_gradients(points, registration.normals, weighted, patch, gradients)
    gradients = gradients @ outward
    sigma2 = min(registration.sigma2, BLIND_STD_M**2)
    scatter: F8 = gradients.T @ gradients + np.diag(INDEPENDENT_SHARE * sigma2 * np.maximum(eigenvalues, 0.0))
    return scatter


@kernel
def _add_gradients(points: F8, normals: F8, weighted: F8, patch: I8, gradients: F8) -> None:
    """Add (p x u, u) w e of every residual to the row of its patch."""
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        ux, uy, uz = normals[n, 0], normals[n, 1], normals[n, 2]
        k, e = patch[n], weighted[n]
        gradients[k, 0] += e * (py * uz - pz * uy)
        gradients[k, 1] += e * (pz * ux - px * uz)
        gradients[k, 2] += e * (px * uy - py * ux)
        gradients[k, 3] += e * ux
        gradients[k, 4] += e * uy
        gradients[k, 5] += e * uz


def _translation_information(H: F8) -> float:
    """Smallest eigenvalue of the translation information with rotation marginalised."""
    schur = H[3:, 3:] - H[3:, :3] @ np.linalg.pinv(H[:3, :3]) @ H[:3, 3:]
    return max(float(np.linalg.eigvalsh(schur)[0]), 0.0)


def _worst_translation(H: F8, sigma2: float) -> float:
    least = _translation_information(H)
    if not np.isfinite(sigma2) or least * BLIND_STD_M**2 <= sigma2:
        return BLIND_STD_M
    return float(np.sqrt(sigma2 / least))


def _normal_cdf(z: F8) -> F8:
    from scipy.special import ndtr

    cdf: F8 = ndtr(z)
    return cdf


@kernel
def _noise_information(
    points: F8, normals: F8, weights: F8, normal_variance: F8, directions: F8, point_variance: Float,
    mean: F8, variance: F8,
) -> None:  # fmt: skip
    """Mean and variance of the information along each direction (a, b) that noise alone gives.

    A residual's row along it is u . (a x p + b). Noise of the normal u adds the part of (a x p + b) across u, noise
    of the point p adds |u x a|^2; the square of a Gaussian of variance v has mean v and variance 2 v^2.
    """
    for k in range(directions.shape[1]):
        ax, ay, az = directions[0, k], directions[1, k], directions[2, k]
        for n in range(len(points)):
            px, py, pz = points[n, 0], points[n, 1], points[n, 2]
            ux, uy, uz = normals[n, 0], normals[n, 1], normals[n, 2]
            lx = ay * pz - az * py + directions[3, k]
            ly = az * px - ax * pz + directions[4, k]
            lz = ax * py - ay * px + directions[5, k]
            along = ux * lx + uy * ly + uz * lz
            across = lx * lx + ly * ly + lz * lz - along * along
            cx, cy, cz = uy * az - uz * ay, uz * ax - ux * az, ux * ay - uy * ax
            noise = normal_variance[n] * across + point_variance * (cx * cx + cy * cy + cz * cz)
            mean[k] += weights[n] * noise
            variance[k] += 2.0 * (weights[n] * noise) ** 2
