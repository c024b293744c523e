"""Mean map entropy and plane variance: how crisp a cloud is, without any truth.

h(q) = 1/2 ln det(2 pi e Sigma(q)), Sigma(q) the sample covariance of the neighbours of q within radius r (q among
them). A plane with Gaussian noise s << r has h = 1/2 ln((2 pi e)^3 r^4 s^2 / 16): ln 2 more when s doubles.
Droeschel and Behnke 2018 use the same figure. Values of tools that define the constant differently do not compare.
The plane variance at q is the least eigenvalue of Sigma(q), s^2 for such a plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.neighbourhoods import Columns, covariances, moments
from scanloom.stages.geometry.se3 import F8

_CONSTANT = 0.5 * 3.0 * np.log(2.0 * np.pi * np.e)
_FLAT = 1e-12
"""A determinant below this share of the cube of the mean variance is rounding."""


def point_entropies(
    points: NDArray[np.float32], queries: NDArray[np.int64], radii_m: tuple[float, ...], min_neighbours: int
) -> F8:
    """Entropy (m, k), nat, at the points with indices `queries` (m,) of `points` (n, 3), m, for k radii.

    Radii increase. NaN where fewer than `min_neighbours` points lie within the radius, or where they lie on a plane exactly.
    """
    if list(radii_m) != sorted(radii_m):
        raise ValueError(f"radii must increase: {radii_m}")
    if len(queries) == 0:
        return np.empty((0, len(radii_m)))
    radii = np.array(radii_m, float)
    found = moments(Columns(points, float(radii[-1])), points[queries].astype(np.float32), radii)
    return entropies(found, min_neighbours)


def entropies(moments: F8, min_neighbours: int) -> F8:
    """Entropy (...,), nat, from moments (..., 10); NaN as in `point_entropies`."""
    sigma = covariances(moments)
    with np.errstate(invalid="ignore", divide="ignore"):
        determinant = _determinants(sigma)
        mean = np.trace(sigma, axis1=-2, axis2=-1) / 3.0
        usable = (moments[..., 0] >= min_neighbours) & (determinant > _FLAT * mean**3)
        return np.where(usable, _CONSTANT + 0.5 * np.log(np.where(usable, determinant, 1.0)), np.nan)


def _determinants(sigma: F8) -> F8:
    """Of symmetric matrices (..., 3, 3), by cofactors."""
    xx, xy, xz = sigma[..., 0, 0], sigma[..., 0, 1], sigma[..., 0, 2]
    yy, yz, zz = sigma[..., 1, 1], sigma[..., 1, 2], sigma[..., 2, 2]
    found: F8 = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return found


def mean_entropy(entropies: F8, weights: F8 | None = None) -> tuple[F8, F8]:
    """Mean map entropy (k,), nat, and the share (k,) of points with enough neighbours, from entropies (m, k).

    weights : (m,) how many points each stands for; one without.
    """
    valid = np.isfinite(entropies)
    weight = np.ones(len(entropies)) if weights is None else weights
    count = (valid * weight[:, None]).sum(axis=0)
    total = np.where(valid, entropies * weight[:, None], 0.0).sum(axis=0)
    mean = np.where(count > 0, total / np.maximum(count, 1e-300), np.nan)
    return mean, count / max(float(weight.sum()), 1e-300)
