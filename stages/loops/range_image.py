"""Range image of a scan, from coordinates alone: rows by elevation, columns by azimuth, the nearest point in each cell.

Deskewed scans do not say which beam a point came from. Where the beams stand apart in elevation each gets a row of its
own; where they blur into each other (sensors whose beams do not meet in one point, fast turns) rows are even.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

BIN_RAD = np.radians(0.05)
BINS = 3600
"""Of elevation, from straight down to straight up."""
BESIDE_BINS = 15
"""0.75 deg: a bin belongs to a beam when it holds a tenth of the fullest bin that near."""
BEAM_SHARE = 0.1
WIDEST_BEAM = 0.7
"""Width of a beam over the distance to the next: wider ones are no beams."""
LEAST_BEAMS = 4
STILL_PER_M = 0.002
"""Beams are told apart by points with |z| / r^2 below this: on the way of half a sweep at town speed (0.6 m) their elevation
changes by less than 0.07 deg. That of near points was changed by more when the scan was deskewed."""
STRAY_SHARE = 0.1
"""Runs of bins with less than this share of the points of the usual run are no beams."""
FILLED_SHARE = 0.97
"""Columns over the points of the fullest row, so that the jitter of azimuths leaves no column empty."""
TAU = 2 * np.pi


class ImageSettings(BaseModel):
    """Size of the range image."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rows: int = Field(
        default=64, ge=2, le=256, description="rows where beams cannot be told apart, and at most, number"
    )
    columns: int = Field(
        default=1800,
        ge=36,
        le=8192,
        description="columns at most (0.2 deg); as many as a beam has points where these are fewer, number",
    )


@dataclass(frozen=True)
class RangeImage:
    """Cells (rows, columns) in row-major order; row 0 is the lowest."""

    point: I4
    """Number of the nearest point in the cell, -1 where there is none."""
    range_m: F4
    """Its range; 0 where there is none."""
    elevation_rad: F8
    """(rows,) elevation of the middle of each row."""
    column_rad: float
    """Azimuth between columns."""


def range_image(settings: ImageSettings, x_m: F4, y_m: F4, z_m: F4, seen: B1, drawn: B1) -> RangeImage:
    """The image of the points `drawn` (n,); its rows and columns are laid out by all points `seen` (n,).

    Points without finite coordinates, or in the origin, are in neither.
    """
    elevation, azimuth, counts = _angles(x_m, y_m, z_m, seen)
    edges = _row_edges(settings, elevation, counts)
    row = np.searchsorted(edges, elevation, side="right").astype(np.int32)
    row[np.isnan(elevation)] = -1
    rows = len(edges) + 1
    fullest = int(np.bincount(row[row >= 0], minlength=1).max())
    columns = int(np.clip(FILLED_SHARE * fullest, 36, settings.columns))
    point, ranges = np.full((rows, columns), -1, np.int32), np.zeros((rows, columns), np.float32)
    _draw(x_m, y_m, z_m, drawn, row, azimuth, point, ranges)
    return RangeImage(point, ranges, _row_middles(row, elevation, edges), TAU / columns)


def _row_edges(settings: ImageSettings, elevation: F4, counts: I8) -> F8:
    """Elevations (rows - 1,) between rows, from below; `counts` of points per bin of elevation."""
    if np.isnan(elevation).all():
        return np.empty(0)
    low, high = float(np.nanmin(elevation)), float(np.nanmax(elevation))
    first, last = _beams(counts)
    total = np.concatenate(([0], np.cumsum(counts)))
    points = total[last + 1] - total[first]
    real = points >= STRAY_SHARE * np.median(points) if len(points) else np.zeros(0, np.bool_)
    first, last = first[real], last[real]
    if len(first) >= LEAST_BEAMS:
        step = _step(0.5 * (first + last)) * BIN_RAD
        between = 0.5 * (last[:-1] + 1 + first[1:]) * BIN_RAD - np.pi / 2
        below = np.arange(between[0] - step, low, -step)[::-1]
        above = np.arange(between[-1] + step, high, step)
        narrow = np.median(last - first + 1) * BIN_RAD <= WIDEST_BEAM * step
        if narrow and len(below) + len(between) + len(above) < settings.rows:
            return np.concatenate((below, between, above))
    return np.linspace(low, high + 1e-6, settings.rows + 1)[1:-1]


def _step(middles: F8) -> float:
    """Mean distance of beams next to each other; wide gaps, where beams saw nothing, are left out."""
    steps = np.diff(middles)
    return float(np.mean(steps[steps < 1.5 * np.median(steps)]))


def _row_middles(row: I4, elevation: F4, edges: F8) -> F8:
    """Mean elevation of the points of each row; of an empty one, the middle between its edges."""
    ends = np.concatenate((edges[:1], edges, edges[-1:])) if len(edges) else np.zeros(2)
    known = row >= 0
    count = np.bincount(row[known], minlength=len(ends) - 1)
    total = np.bincount(row[known], weights=elevation[known], minlength=len(ends) - 1)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), 0.5 * (ends[:-1] + ends[1:])))


@kernel
def _angles(x: F4, y: F4, z: F4, seen: B1) -> tuple[F4, F4, I8]:
    """Elevation and azimuth (n,), rad, NaN for points that are not seen; points that tell beams apart per bin of elevation."""
    elevation, azimuth = np.full(len(x), np.nan, np.float32), np.full(len(x), np.nan, np.float32)
    counts = np.zeros(BINS, np.int64)
    for n in range(len(x)):
        flat = np.sqrt(x[n] * x[n] + y[n] * y[n])
        if not seen[n] or not 0.0 < flat + abs(z[n]) < np.inf:
            continue
        elevation[n] = np.arctan2(z[n], flat)
        azimuth[n] = np.arctan2(y[n], x[n])
        if abs(z[n]) < STILL_PER_M * flat * flat:
            counts[min(max(int((elevation[n] + np.pi / 2) / BIN_RAD), 0), BINS - 1)] += 1
    return elevation, azimuth, counts


@kernel
def _beams(counts: I8) -> tuple[I8, I8]:
    """First and last bins of runs of well-filled bins."""
    first, last = np.empty(BINS, np.int64), np.empty(BINS, np.int64)
    found: Int = 0
    inside = False
    for k in range(BINS):
        most = counts[max(k - BESIDE_BINS, 0) : min(k + BESIDE_BINS + 1, BINS)].max() if counts[k] else 0
        if counts[k] > BEAM_SHARE * most:
            if not inside:
                first[found] = k
                found += 1
            last[found - 1] = k
            inside = True
        else:
            inside = False
    return first[:found].copy(), last[:found].copy()


@kernel
def _draw(x: F4, y: F4, z: F4, drawn: B1, row: I4, azimuth: F4, point: I4, ranges: F4) -> None:
    columns = point.shape[1]
    for n in range(len(x)):
        if not drawn[n] or row[n] < 0:
            continue
        column = int((azimuth[n] / TAU + 0.5) * columns) % columns
        r = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        if point[row[n], column] < 0 or r < ranges[row[n], column]:
            point[row[n], column] = n
            ranges[row[n], column] = r
