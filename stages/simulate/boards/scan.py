"""A turn of the LiDAR in the room: wide beams, points between two surfaces, beams with errors of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.simulate.boards.print import WHITE, Print
from scanloom.stages.simulate.boards.room import Look, Scenery
from scanloom.stages.simulate.boards.settings import BoardSettings
from scanloom.stages.simulate.eye import meet

LOW_DEG = {16: -15.0, 32: -25.0, 64: -25.0}
HIGH_DEG = 15.0
MIN_RANGE_M = 0.4
_APART_M = 0.6
"""Echoes of one beam nearer to each other than this come back as one, between them."""
_FOOT = np.array([(0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7)])
"""Parts of a beam's foot, of half its width."""
_POWER = np.array([0.32, 0.17, 0.17, 0.17, 0.17])


@dataclass(frozen=True)
class Cloud:
    """One turn, in the LiDAR's frame, as its user gets it."""

    points_m: NDArray[np.float32]
    """(n, 3)"""
    intensity: NDArray[np.float32]
    """(n,) 0 to 255: white paper is about 80."""
    ring: NDArray[np.uint16]


@dataclass(frozen=True)
class Scanner:
    """What is wrong with this very LiDAR."""

    offset_m: float
    beam_m: F8
    """(beams,)"""
    skew_rad: F8
    """(2, beams) azimuth and elevation."""

    @classmethod
    def of(cls, settings: BoardSettings, rng: np.random.Generator) -> Scanner:
        s = settings
        return cls(
            s.range_offset_m * float(rng.standard_normal()),
            s.beam_range_error_m * rng.standard_normal(s.beams),
            np.radians(s.beam_angle_error_deg) * rng.standard_normal((2, s.beams)),
        )

    def scan(
        self,
        settings: BoardSettings,
        scene: Any,
        scenery: Scenery,
        board: Print,
        T_lidar_board: F8,
        rng: np.random.Generator,
    ) -> Cloud:
        """One turn of the room; points column by column, as they were measured."""
        s = settings
        azimuth = np.pi - 2 * np.pi * (np.arange(s.columns) + rng.random()) / s.columns
        elevation = np.radians(np.linspace(LOW_DEG[s.beams], HIGH_DEG, s.beams))
        range_m, back = self._echoes(s, scene, scenery, board, inverse(T_lidar_board), azimuth, elevation)
        beam = np.tile(np.arange(s.beams), s.columns)
        darker = s.dark_m * np.clip(1.0 - back / WHITE, 0.0, 1.0)
        measured = range_m + self.offset_m + self.beam_m[beam] + darker
        measured = measured + s.range_noise_m * rng.standard_normal(len(measured))
        measured = np.round(measured / 0.002) * 0.002
        lost = rng.random(len(measured)) < 0.01 + 0.2 * (back < 0.02)
        kept = np.isfinite(range_m) & ~lost & (measured > MIN_RANGE_M)
        shine = 100.0 * back * (1 + 0.08 * rng.standard_normal(len(back)))
        told = _spread(azimuth, elevation).reshape(-1, 3)
        return Cloud(
            (told[kept] * measured[kept, None]).astype(np.float32),
            np.clip(np.round(shine[kept]), 0, 255).astype(np.float32),
            beam[kept].astype(np.uint16),
        )

    def _echoes(
        self, s: BoardSettings, scene: Any, scenery: Scenery, board: Print, T_board_lidar: F8, azimuth: F8, elevation: F8
    ) -> tuple[F8, F8]:  # fmt: skip
        """Range and share of light of what comes back from each beam's foot."""
        n = s.columns * s.beams
        ranges, shares = np.empty((len(_FOOT), n)), np.empty((len(_FOOT), n))
        for k, (right, up) in enumerate(0.5 * s.divergence_rad * _FOOT):
            d = _spread(azimuth[:, None] + self.skew_rad[0] + right, elevation + self.skew_rad[1] + up)
            d = d.reshape(-1, 3)
            hit = meet(scene, np.zeros(3), d)
            ranges[k] = hit.range_m
            points = d * np.where(hit.found, hit.range_m, 0.0)[:, None]
            colour = scenery.reflectance(hit.triangle, points, T_board_lidar, board)
            shining = scenery.look[hit.triangle] == Look.SHINING
            cosine = np.abs(np.einsum("ni,ni->n", hit.normal, d))
            shares[k] = np.where(hit.found & ~shining, colour.mean(axis=1) * np.maximum(cosine, 0.1), 0.0)
        return _joined_echo(ranges, shares)


def _joined_echo(ranges: F8, shares: F8) -> tuple[F8, F8]:
    """What a receiver makes of the parts (k, n): the stronger of two echoes that lie apart, the mean of those that do
    not."""
    power = _POWER[:, None] * np.maximum(shares, 1e-4) * np.isfinite(ranges)
    finite = np.where(np.isfinite(ranges), ranges, 0.0)
    nearest = np.where(np.isfinite(ranges), ranges, np.inf).min(axis=0)
    near = (ranges < nearest + _APART_M) & np.isfinite(ranges)
    far_power = (power * ~near / np.maximum(finite, 1.0) ** 2).sum(axis=0)
    near_power = (power * near / np.maximum(finite, 1.0) ** 2).sum(axis=0)
    chosen = np.where(near_power >= far_power, near, ~near & np.isfinite(ranges))
    weight = power * chosen
    total = weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        range_m = (weight * finite).sum(axis=0) / total
    parts = (_POWER[:, None] * chosen).sum(axis=0)
    share = (_POWER[:, None] * shares * chosen).sum(axis=0) / np.maximum(parts, 1e-9)
    return np.where(total > 0, range_m, np.inf), share


def _spread(azimuth: F8, elevation: F8) -> F8:
    """Unit directions (columns, beams, 3)."""
    a, e = np.broadcast_arrays(azimuth if azimuth.ndim == 2 else azimuth[:, None], elevation)
    return np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=-1)
