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
from scanloom.stages.geometry.voxels import Float

SNR = 10.0
POINT_NOISE_M = 0.02
BLIND_STD_M = 10.0
EIGENVALUE_FLOOR = 1e-9
LEAST_POINTS = 6


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
    """

    d: float
    e_m: float
    p: F8
    directions: F8
    eigenvalues: F8
    range_m: float

    @property
    def scale(self) -> F8:
        """(6,) factors s with xi = s * y."""
        return _scale(self.range_m)

    def observed(self, least_p: float) -> F8:
        """Directions (6, k) with p of at least `least_p`, as columns in the unscaled tangent."""
        return self.scale[:, None] * self.directions[:, self.p >= least_p]


def blind() -> Degeneracy:
    """A scan that saw nothing."""
    return Degeneracy(0.0, BLIND_STD_M, np.zeros(6), np.eye(6), np.zeros(6), 1.0)


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
    )


def scan_covariance(
    seen: Degeneracy,
    sigma2: float,
    *,
    inflation: float,
    floor_m: float,
    floor_rad: float,
    predicted: F8,
    least_p: float,
) -> F8:
    """Covariance (6, 6) of a registered motion (methods 1.8), right tangent, order (rotation, translation).

    Well observed directions get inflation * sigma2 / lambda; directions with p below `least_p` were taken from the
    prediction and get its covariance `predicted` (6, 6); the floors, squared, are added to all.
    """
    scale = seen.scale
    inside = seen.directions.T @ (predicted / scale[:, None] / scale) @ seen.directions
    strong = seen.p >= least_p
    inside = np.where(strong[:, None] | strong, 0.0, inside)
    known = np.where(strong, seen.eigenvalues, np.inf)
    inside = inside + np.diag(inflation * min(sigma2, BLIND_STD_M**2) / np.maximum(known, EIGENVALUE_FLOOR))
    covariance = (seen.directions @ inside @ seen.directions.T) * scale[:, None] * scale
    covariance = covariance + np.diag([floor_rad**2] * 3 + [floor_m**2] * 3)
    symmetric: F8 = 0.5 * (covariance + covariance.T)
    return symmetric


def _scale(range_m: float) -> F8:
    return np.array([1 / range_m] * 3 + [1.0] * 3)


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
