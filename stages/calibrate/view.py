"""What a cloud says about one board, as rows that a graph can hold: pose and errors of the sensor together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.calibrate.cloud.evidence import SENSOR
from scanloom.stages.calibrate.factors import cloud_rows
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.geometry.se3 import F8, so3_exp

I8 = NDArray[np.int64]
SHARED = len(SENSOR)
"""Unknowns of the sensor before its beams."""


@dataclass(frozen=True)
class LidarView:
    """The board in one cloud: ranges along their rays, edges and squares as one linear system.

    |root (xi, sensor) + gap|^2 is their sum of squares near `T_lidar_board`, in units of their noise; xi is turn and shift
    (6,) of the board in its frame, sensor is (those of `SENSOR`, offsets of `beams`), m.
    """

    T_lidar_board: F8
    beams: I8
    root: F8
    gap: F8
    points: int = 0
    edge_points: int = 0


@dataclass(frozen=True)
class Sensor:
    """What is known of the LiDAR: (those of `SENSOR`, offset of each beam), m, and how well."""

    beams: I8
    mean: F8
    covariance: F8

    @classmethod
    def unknown(cls, beams: I8, noise: Noise) -> Sensor:
        """Before anything was seen."""
        size = SHARED + len(beams)
        sigma = np.r_[noise.sensor_m, np.full(len(beams), noise.beam_offset_m)]
        covariance = np.diag(sigma**2 + _NEVER_ZERO)
        return cls(beams, np.zeros(size), covariance)

    def columns(self, view: LidarView) -> I8:
        """Where the sensor's unknowns of a view stand among all."""
        return np.concatenate((np.arange(SHARED), SHARED + np.searchsorted(self.beams, view.beams)))

    def known(self, name: str) -> tuple[float, float]:
        """One of `SENSOR`, m, and its standard deviation."""
        i = SENSOR.index(name)
        return float(self.mean[i]), float(np.sqrt(self.covariance[i, i]))


_NEVER_ZERO = 1e-12


def all_beams(views: Sequence[LidarView]) -> I8:
    """Names of all beams, sorted."""
    return np.unique(np.concatenate([view.beams for view in views])) if views else np.empty(0, np.int64)


@dataclass(frozen=True)
class Rows:
    """A view with the noise of whole boards and of beams within a placement taken in."""

    T_lidar_board: F8
    by_board: F8
    """(r, 6)."""
    by_sensor: F8
    """(r, n) by all unknowns of the sensor."""
    gap: F8

    def at(self, T_lidar_board: F8, sensor: F8) -> tuple[F8, F8]:
        """Errors (r,) and derivatives (r, 6) by the board's tangent."""
        xi, slopes = cloud_rows(T_lidar_board, self.T_lidar_board)
        return self.by_board @ xi + self.by_sensor @ sensor + self.gap, self.by_board @ slopes

    def board(self, sensor: Sensor) -> tuple[F8, F8]:
        """Pose (4, 4) of the board with what is known of the sensor, and its covariance (6, 6)."""
        spread = np.linalg.cholesky(sensor.covariance + 1e-14 * np.eye(len(sensor.mean)))
        J = np.block(
            [[self.by_board, self.by_sensor @ spread], [np.zeros((len(spread), 6)), np.eye(len(spread))]]
        )
        e = np.concatenate((self.gap + self.by_sensor @ sensor.mean, np.zeros(len(spread))))
        covariance = np.linalg.inv(J.T @ J + 1e-9 * np.eye(J.shape[1]))
        xi = -(covariance @ (J.T @ e))[:6]
        return moved(self.T_lidar_board, xi), np.asarray(covariance[:6, :6])


def moved(T: F8, xi: F8) -> F8:
    """A board turned and shifted (6,) in its own frame; the inverse of `cloud_rows`."""
    out = T.copy()
    out[:3, :3] = T[:3, :3] @ so3_exp(xi[:3])
    out[:3, 3] = T[:3, 3] + T[:3, :3] @ xi[3:]
    return out


def rows_of(view: LidarView, sensor: Sensor, noise: Noise) -> Rows:
    """Two kinds of errors more, eliminated by QR: of the whole board (6), and of every beam in this placement.

    A beam's offset repeats from placement to placement, but for some millimetres that depend on what it meets.
    """
    k = len(view.beams)
    own = np.concatenate((view.root[:, :6] * noise.bias_sigmas, view.root[:, -k:] * noise.beam_m), axis=1)
    nuisance = own.shape[1]
    stacked = np.block(
        [
            [own, view.root, view.gap[:, None]],
            [np.eye(nuisance), np.zeros((nuisance, view.root.shape[1] + 1))],
        ]
    )
    triangle: F8 = np.asarray(np.linalg.qr(stacked, mode="r"))
    left = triangle[nuisance:, nuisance:]
    by_sensor = np.zeros((len(left), len(sensor.mean)))
    by_sensor[:, sensor.columns(view)] = left[:, 6:-1]
    return Rows(view.T_lidar_board, left[:, :6], by_sensor, left[:, -1])


def beam_gaps(view: LidarView, T_lidar_board: F8, sensor: Sensor) -> tuple[F8, F8]:
    """Offsets of the beams in this placement beyond the sensor's (k,), m, were the board there; and their variances."""
    xi, _ = cloud_rows(T_lidar_board, view.T_lidar_board)
    mean = sensor.mean[sensor.columns(view)]
    e = view.root @ np.concatenate((xi, mean)) + view.gap
    J = view.root[:, 6 + SHARED :]
    covariance = np.linalg.inv(J.T @ J + 1e-3 * np.eye(J.shape[1]))
    return -(covariance @ (J.T @ e)), np.diag(covariance)
