"""A cloud as the sensor took it: rays in the order of beams and azimuth."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.range_image import ImageSettings, range_image
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]
B1 = NDArray[np.bool_]
_AGAIN_RAD = 2.0
"""Azimuths that are there twice, so that nothing is cut in two at the seam."""
_GAP_RAD = np.radians(20.0)
_MOST_ROWS = 256


@dataclass(frozen=True)
class Sweep:
    """Rays sorted by (beam, azimuth). Those in the first 2 rad of azimuth come again behind the seam."""

    source: I8
    """Number of the point in the cloud as it came."""
    direction: F8
    """Unit vectors (n, 3)."""
    range_m: F8
    intensity: F8
    beam: I8
    """0 is the lowest."""
    name: I8
    """(beams,) what the sensor calls each: its ring, or without rings its elevation in tenths of a degree."""
    azimuth: F8
    """rad, from -pi to pi + 2, growing to the left."""
    foreground: B1
    """Not of the background."""
    step_rad: F8
    """Usual distance of neighbours, by beam."""
    first_beam: I8
    """(beams + 1,) where each beam starts."""
    blind: tuple[float, float] | None
    """Azimuths between which no beam ever sees anything, in [-pi, pi + 2]; None for a sensor that looks all around."""

    @property
    def points(self) -> F8:
        return self.direction * self.range_m[:, None]

    def window(self, azimuth: float, half_rad: float) -> I8:
        """Rays whose azimuth is no farther than `half_rad` from one, in order."""
        parts = []
        for start, end in pairwise(self.first_beam):
            low, high = np.searchsorted(self.azimuth[start:end], (azimuth - half_rad, azimuth + half_rad))
            parts.append(np.arange(start + low, start + high))
        return np.concatenate(parts)


def sweep_of(points: F8, intensity: F8, beam: I8 | None, foreground: B1, nearest_m: float) -> Sweep:
    """Rays of points (n, 3) about the sensor's origin; those that are not finite or nearer than `nearest_m` are left out.

    Without `beam` beams are told apart by elevation; where they cannot be, rows of equal elevation stand for them.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.linalg.norm(points, axis=1)
    good = np.flatnonzero(np.isfinite(distance) & (distance > nearest_m))
    x, r = points[good], distance[good]
    rows, names = _by_elevation(x, r) if beam is None else _ranked(x, r, beam[good])
    azimuth = np.arctan2(x[:, 1], x[:, 0])
    again = np.flatnonzero(azimuth < -np.pi + _AGAIN_RAD)
    pick = np.concatenate((np.arange(len(good)), again))
    wide = np.concatenate((azimuth, azimuth[again] + 2 * np.pi))
    order = np.lexsort((wide, rows[pick]))
    pick, wide = pick[order], wide[order]
    beams = rows[pick]
    first = np.searchsorted(beams, np.arange(beams[-1] + 2 if len(beams) else 1))
    light = np.where(np.isfinite(intensity), intensity, 0.0)
    return Sweep(
        source=good[pick],
        direction=x[pick] / r[pick, None],
        range_m=r[pick],
        intensity=light[good][pick].astype(np.float64),
        beam=beams,
        name=names,
        azimuth=wide,
        foreground=foreground[good][pick],
        step_rad=_steps(wide, first),
        first_beam=first,
        blind=_blind(azimuth),
    )


def _ranked(x: F8, r: F8, beam: I8) -> tuple[I8, I8]:
    """Beams (n,) numbered by their middle elevation, and their names."""
    names, number = np.unique(beam, return_inverse=True)
    order = np.argsort(number, kind="stable")
    ends = np.cumsum(np.bincount(number, minlength=len(names)))[:-1]
    middle = [np.median(part) for part in np.split((x[:, 2] / r)[order], ends)]
    upwards = np.argsort(middle, kind="stable")
    rank = np.empty(len(names), np.int64)
    rank[upwards] = np.arange(len(names))
    return rank[number], names[upwards].astype(np.int64)


def _by_elevation(x: F8, r: F8) -> tuple[I8, I8]:
    east, north, up = (np.ascontiguousarray(x[:, k], np.float32) for k in range(3))
    everything = np.ones(len(x), np.bool_)
    image = range_image(ImageSettings(rows=_MOST_ROWS), east, north, up, everything, everything)
    columns = round(2 * np.pi / image.column_rad)
    rows, names = _ranked(x, r, (image.cell // columns).astype(np.int64))
    middle = np.degrees(image.elevation_rad[names])
    return rows, np.round(10 * middle).astype(np.int64)


def _steps(azimuth: F8, first: I8) -> F8:
    out = np.full(len(first) - 1, np.nan)
    for k, (start, end) in enumerate(pairwise(first)):
        if end - start > 2:
            out[k] = np.median(np.diff(azimuth[start:end]))
    usual = np.nanmedian(out) if np.isfinite(out).any() else np.radians(0.2)
    return np.where(np.isfinite(out), out, usual)


def _blind(azimuth: F8) -> tuple[float, float] | None:
    if not len(azimuth):
        return None
    turn = np.sort(azimuth)
    gaps = np.diff(np.append(turn, turn[0] + 2 * np.pi))
    k = int(np.argmax(gaps))
    return (float(turn[k]), float(turn[k] + gaps[k])) if gaps[k] > _GAP_RAD else None
