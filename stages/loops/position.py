"""Candidates by geometry alone: keyframes that odometry places near each other, as far as it can be trusted (methods 1.11)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, adjoint

I8 = NDArray[np.int64]


class PositionSettings(BaseModel):
    """How near is near."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    radius_m: float = Field(default=15.0, gt=0, le=200, description="horizontal distance always near, m")
    height_m: float = Field(
        default=4.0, gt=0, le=100, description="vertical distance always near; decks of a crossing are not, m"
    )
    sigmas: float = Field(
        default=3.0,
        ge=0,
        le=10,
        description="near is also what the relative marginal does not rule out, sigmas",
    )
    drift_share: float = Field(
        default=0.003,
        ge=0,
        le=0.2,
        description="standard deviation of odometry's systematic error, which its covariances do not hold, per metre driven",
    )
    max_radius_m: float = Field(default=50.0, gt=0, le=500, description="farther is never near, m")


def accumulated(odometry: Odometry) -> F8:
    """Covariance (n, 6, 6) of all motions up to each scan, as twists about the origin of `odom`.

    sum of Ad(T_k) C_k Ad(T_k)^T: the difference of two is that of the motion in between, for any two scans.
    """
    A = adjoint(odometry.T_odom_lidar)
    return np.cumsum(A @ odometry.covariance @ np.swapaxes(A, 1, 2), axis=0)


def nearest_earlier(
    settings: PositionSettings, position_m: F8, spread: F8, travelled_m: F8, queries: I8, admitted: I8
) -> tuple[I8, F8]:
    """Of each of the keyframes `queries` (n,), the one nearest in units of what is near among the first `admitted` (n,).

    Returns its number, -1 where none is near, and the distance in these units, below 1.

    Parameters
    ----------
    position_m : (k, 3) by odometry.
    spread : (k, 6, 6) from `accumulated`.
    """
    place, share = np.full(len(queries), -1, np.int64), np.ones(len(queries))
    limits = np.array(
        [settings.radius_m, settings.height_m, settings.sigmas, settings.drift_share, settings.max_radius_m]
    )
    _nearest(
        np.ascontiguousarray(position_m), np.ascontiguousarray(spread), np.ascontiguousarray(travelled_m), queries,
        admitted, limits, place, share,
    )  # fmt: skip
    return place, share


@kernel
def _nearest(
    p: F8, spread: F8, travelled: F8, queries: I8, admitted: I8, limits: F8, place: I8, share: F8
) -> None:  # fmt: skip
    radius, height, sigmas, drift, most = limits[0], limits[1], limits[2], limits[3], limits[4]
    for q in range(len(queries)):
        j = queries[q]
        i = 0
        while i < admitted[q]:
            flat = np.sqrt((p[j, 0] - p[i, 0]) ** 2 + (p[j, 1] - p[i, 1]) ** 2)
            if flat > most:  # no nearer one before this much path
                i = max(i + 1, np.searchsorted(travelled, travelled[i] + flat - most))
                continue
            level, up = _variances(spread[j] - spread[i], p[j])
            systematic = (drift * (travelled[j] - travelled[i])) ** 2
            near = min(max(radius, sigmas * np.sqrt(level + systematic)), most)
            tall = max(height, sigmas * np.sqrt(up + systematic))
            if flat < near * share[q] and abs(p[j, 2] - p[i, 2]) < tall:
                place[q], share[q] = i, flat / near
            i += 1


@kernel
def _variances(W: F8, p: F8) -> tuple[float, float]:
    """Variance m2 of the position p: the larger horizontal one, and the vertical; W (6, 6) was accumulated in between.

    A twist (n, v) about the origin moves p by v + n x p: C = J W J^T with J = (-[p]x, I).
    """
    J = np.zeros((3, 6))
    J[0, 1], J[0, 2], J[0, 3] = p[2], -p[1], 1.0
    J[1, 0], J[1, 2], J[1, 4] = -p[2], p[0], 1.0
    J[2, 0], J[2, 1], J[2, 5] = p[1], -p[0], 1.0
    xx, xy, yy, zz = 0.0, 0.0, 0.0, 0.0
    for a in range(6):
        for b in range(6):
            xx += J[0, a] * W[a, b] * J[0, b]
            xy += J[0, a] * W[a, b] * J[1, b]
            yy += J[1, a] * W[a, b] * J[1, b]
            zz += J[2, a] * W[a, b] * J[2, b]
    larger = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return max(larger, 0.0), max(zz, 0.0)
