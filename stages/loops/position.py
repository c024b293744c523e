"""Candidates by geometry alone: keyframes that odometry places near each other, as far as it can be trusted (methods 1.11)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, adjoint

I8 = NDArray[np.int64]
B1 = NDArray[np.bool_]


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
    doubt: float = Field(
        default=2.0,
        ge=1,
        le=1000,
        description="looks count against odometry up to this many times what is near; beyond, a place only looks the same",
    )


def accumulated(odometry: Odometry) -> F8:
    """Covariance (n, 6, 6) of all motions up to each scan, as twists about the origin of `odom`.

    sum of Ad(T_k) C_k Ad(T_k)^T: the difference of two is that of the motion in between, for any two scans of a segment.
    """
    A = adjoint(odometry.T_odom_lidar)
    told = np.diff(odometry.segment, prepend=-1) == 0  # what lies between segments would drown all else
    return np.cumsum(A @ (odometry.covariance * told[:, None, None]) @ np.swapaxes(A, 1, 2), axis=0)


@dataclass(frozen=True)
class Whereabouts:
    """Where odometry puts the keyframes (n,) of one track, and how well it knows."""

    position_m: F8
    """(n, 3)"""
    spread: F8
    """(n, 6, 6) from `accumulated`."""
    travelled_m: F8

    def nearest_earlier(self, settings: PositionSettings, queries: I8, admitted: I8) -> tuple[I8, F8]:
        """Of each of the keyframes `queries` (m,), the nearest of the first `admitted` (m,), in units of what is near.

        Returns its number, -1 where none is near, and the distance in these units, below 1.
        """
        place, share = np.full(len(queries), -1, np.int64), np.ones(len(queries))
        _nearest(*self._arrays(), queries, admitted, _limits(settings), place, share)
        return place, share

    def ruled_out(self, settings: PositionSettings, i: I8, j: I8) -> B1:
        """Which pairs of keyframes, arrays of one shape, are farther apart than `doubt` times what is near."""
        out = np.zeros(i.size, np.bool_)
        _far(
            *self._arrays(),
            np.ascontiguousarray(i.ravel()),
            np.ascontiguousarray(j.ravel()),
            _limits(settings),
            out,
        )
        return out.reshape(i.shape)

    def spread_m(self, i: int, j: int) -> tuple[float, float]:
        """Standard deviations of where j is seen from i, m: the larger horizontal one, and the vertical one."""
        first, last = min(i, j), max(i, j)
        W = np.ascontiguousarray(self.spread[last] - self.spread[first])
        level, up = _variances(W, np.ascontiguousarray(self.position_m[last]))
        return float(np.sqrt(level)), float(np.sqrt(up))

    def _arrays(self) -> tuple[F8, F8, F8]:
        return tuple(np.ascontiguousarray(a) for a in (self.position_m, self.spread, self.travelled_m))  # type: ignore[return-value]


def _limits(settings: PositionSettings) -> F8:
    return np.array(
        [
            settings.radius_m, settings.height_m, settings.sigmas, settings.drift_share, settings.max_radius_m,
            settings.doubt,
        ]
    )  # fmt: skip


@kernel
def _nearest(
    p: F8, spread: F8, travelled: F8, queries: I8, admitted: I8, limits: F8, place: I8, share: F8
) -> None:  # fmt: skip
    most = limits[4]
    for q in range(len(queries)):
        j = queries[q]
        i = 0
        while i < admitted[q]:
            flat = np.hypot(p[j, 0] - p[i, 0], p[j, 1] - p[i, 1])
            if flat > most:  # no nearer one before this much path
                i = max(i + 1, np.searchsorted(travelled, travelled[i] + flat - most))
                continue
            near, tall = _near(p, spread, travelled, i, j, limits)
            near = min(near, most)
            if flat < near * share[q] and abs(p[j, 2] - p[i, 2]) < tall:
                place[q], share[q] = i, flat / near
            i += 1


@kernel
def _far(p: F8, spread: F8, travelled: F8, i: I8, j: I8, limits: F8, out: B1) -> None:
    for k in range(len(i)):
        near, tall = _near(p, spread, travelled, i[k], j[k], limits)
        flat = np.hypot(p[j[k], 0] - p[i[k], 0], p[j[k], 1] - p[i[k], 1])
        out[k] = flat > limits[5] * near or abs(p[j[k], 2] - p[i[k], 2]) > limits[5] * tall


@kernel
def _near(p: F8, spread: F8, travelled: F8, i: int, j: int, limits: F8) -> tuple[float, float]:
    """Horizontal and vertical distance, m, that count as near."""
    first, last = min(i, j), max(i, j)
    level, up = _variances(spread[last] - spread[first], p[last])
    systematic = (limits[3] * (travelled[last] - travelled[first])) ** 2
    return (
        max(limits[0], limits[2] * np.sqrt(level + systematic)),
        max(limits[1], limits[2] * np.sqrt(up + systematic)),
    )


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
