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
I2 = NDArray[np.int16]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

BINS = 3600
BIN_RAD = np.pi / BINS
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
LEAST_COLUMNS = 36
TAU = 2 * np.pi

ATAN = tuple(np.float32(c / TAU) for c in (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351))
ZERO, QUARTER, HALF, WHOLE, TINY = (np.float32(c) for c in (0.0, 0.25, 0.5, 1.0, 1e-30))
ENDLESS, CALM_BITS = np.float32(np.inf), 32
CALM = 1 << CALM_BITS
BINS_PER_TURN, LAST_BIN = np.float32(2 * BINS), np.int32(BINS - 1)


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
    row_of_bin: I4
    """(BINS,) row of each bin of elevation (`elevation_bin`)."""
    cell: I4
    """(n,) row * columns + column of each point, -1 for those that are not drawn."""


def range_image(settings: ImageSettings, x_m: F4, y_m: F4, z_m: F4, seen: B1, drawn: B1) -> RangeImage:
    """The image of those of the points `seen` (n,) that are `drawn` (n,); its rows and columns are laid out by all seen.

    Points without finite coordinates, or in the origin, are in neither.
    """
    elevation, counts, still = _elevations(x_m, y_m, z_m, seen)
    first = _first_bins(settings, counts, still)
    points = np.add.reduceat(counts, first) if counts.any() else np.zeros(1, np.int64)
    middle = np.add.reduceat(counts * (np.arange(BINS) + 0.5), first) / np.maximum(points, 1)
    ends = np.append(first, BINS)
    middle = np.where(points > 0, middle, 0.5 * (ends[:-1] + ends[1:])) * BIN_RAD - np.pi / 2
    columns = int(np.clip(FILLED_SHARE * points.max(), LEAST_COLUMNS, settings.columns))
    row = np.repeat(np.arange(len(first), dtype=np.int32), np.diff(ends))
    point, ranges = np.full((len(first), columns), -1, np.int32), np.zeros((len(first), columns), np.float32)
    cell = _draw(x_m, y_m, z_m, drawn, elevation, row, point, ranges)
    return RangeImage(point, ranges, middle, TAU / columns, row, cell)


def _first_bins(settings: ImageSettings, counts: I8, still: I8) -> I8:
    """First bin of elevation of each row, from below; `still` counts the points that tell beams apart."""
    filled = np.flatnonzero(counts)
    if not len(filled):
        return np.zeros(1, np.int64)
    low, high = float(filled[0]), float(filled[-1] + 1)
    edges = _beam_edges(settings, still, low, high)
    if edges is None:
        edges = np.linspace(low, high, settings.rows + 1)[1:-1]
    return np.unique(np.append(0, np.round(edges).astype(np.int64)))


def _beam_edges(settings: ImageSettings, still: I8, low: float, high: float) -> F8 | None:
    """Bins between beams, from `low` to `high`; None where beams cannot be told apart or are more than the rows."""
    first, last = _beams(still)
    total = np.concatenate(([0], np.cumsum(still)))
    points = total[last + 1] - total[first]
    real = points >= STRAY_SHARE * np.median(points) if len(points) else np.zeros(0, np.bool_)
    first, last = first[real], last[real]
    if len(first) < LEAST_BEAMS:
        return None
    step = _step(0.5 * (first + last))
    between = 0.5 * (last[:-1] + 1 + first[1:])
    below, above = np.arange(between[0] - step, low, -step)[::-1], np.arange(between[-1] + step, high, step)
    if np.median(last - first + 1) > WIDEST_BEAM * step:
        return None
    edges = np.concatenate((below, between, above))
    return edges if len(edges) < settings.rows else None


def _step(middles: F8) -> float:
    """Mean distance of beams next to each other; wide gaps, where beams saw nothing, are left out."""
    steps = np.diff(middles)
    return float(np.mean(steps[steps < 1.5 * np.median(steps)]))


@kernel
def _elevations(x: F4, y: F4, z: F4, seen: B1) -> tuple[I2, I8, I8]:
    """Bin of elevation (n,), -1 for points that are not seen; points per bin, and those that tell beams apart per bin."""
    out, calm = np.empty(len(x), np.int16), np.empty(len(x), np.bool_)
    for n in range(len(x)):  # apart from the counting, so that the compiler takes several points at once
        square = x[n] * x[n] + y[n] * y[n]
        far = square + abs(z[n])
        known = seen[n] & (far > ZERO) & (far < ENDLESS)
        out[n] = elevation_bin(np.sqrt(square), z[n]) if known else -1
        calm[n] = abs(z[n]) < STILL_PER_M * square
    both = np.zeros(BINS + 1, np.int64)
    for n in range(len(x)):
        both[out[n] + 1] += CALM + 1 if calm[n] else 1
    return out, both[1:] & (CALM - 1), both[1:] >> CALM_BITS


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
def _draw(x: F4, y: F4, z: F4, drawn: B1, elevation: I2, row: I4, point: I4, ranges: F4) -> I4:
    columns = point.shape[1]
    cell, away = np.empty(len(x), np.int32), np.empty(len(x), np.float32)
    width, last = np.float32(columns), np.int32(columns - 1)
    for n in range(len(x)):  # apart from the drawing, so that the compiler takes several points at once
        cell[n] = min(np.int32(turn_of(x[n], y[n]) * width), last)
        away[n] = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
    points, nearest = point.ravel(), ranges.ravel()
    for n in range(len(x)):
        if not drawn[n] or elevation[n] < 0:
            cell[n] = -1
            continue
        k = row[elevation[n]] * columns + cell[n]
        cell[n] = k
        if points[k] < 0 or away[n] < nearest[k]:
            points[k], nearest[k] = n, away[n]
    return cell


@kernel
def elevation_bin(level: float, z: float) -> int:
    """Bin of elevation of a point `level` m away on the level and `z` m up."""
    up = turn_of(level, z)
    return min(np.int32((up + QUARTER if up < HALF else up - HALF - QUARTER) * BINS_PER_TURN), LAST_BIN)  # type: ignore[return-value]


@kernel
def turn_of(x: float, y: float) -> float:
    """Direction of (x, y) in [0, 1] turns from x towards y, to 2e-6, in single precision: a third of arctan2's time.

    Abramowitz and Stegun 4.4.47.
    """
    a, b = abs(x), abs(y)
    big, small = (a, b) if a > b else (b, a)
    t = small / (big if big > TINY else TINY)
    s = t * t
    turn = t * (ATAN[0] + s * (ATAN[1] + s * (ATAN[2] + s * (ATAN[3] + s * ATAN[4]))))
    turn = QUARTER - turn if b > a else turn
    turn = HALF - turn if x < ZERO else turn
    turn = WHOLE - turn if y < ZERO else turn
    return turn  # type: ignore[return-value]  # float() would widen it
