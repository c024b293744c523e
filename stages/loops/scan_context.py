"""Scan contexts: what a place looks like from any heading, and how alike two of them are.

Scan Context (Kim and Kim, IROS 2018; methods 2.4), written from its formulae: the highest point per ring and sector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import turn_of
from scanloom.stages.geometry.voxels import Int

F4 = NDArray[np.float32]
I2 = NDArray[np.int16]
B1 = NDArray[np.bool_]

RINGS, SECTORS = 20, 60
LEAST_COMMON_COLUMNS = 12
"""Columns that are empty in one of the two say nothing; with fewer common ones two nearly empty scans would be alike."""
LENGTH = 4095
"""Of a column, in whole numbers: half the memory of floats, and sums that do not depend on their order."""
STEPS_PER_M = 64.0
"""Heights are rounded to 1.6 cm: they are a tenth of the size in a file."""
TAU = 2 * np.pi


def scan_contexts(
    x_m: F4,
    y_m: F4,
    z_m: F4,
    drawn: B1,
    max_radius_m: float,
    height_offset_m: float,
    lanes_m: Sequence[float],
) -> F4:
    """Highest point (lanes, 20, 60), m above the offset, per ring of max_radius/20 and sector of 6 degrees; 0 where none is.

    Parameters
    ----------
    drawn : (n,) points that count; those without finite coordinates never do.
    lanes_m : how far to the left of the LiDAR the middle of the rings is, m.
    """
    out = np.zeros((len(lanes_m), RINGS, SECTORS), np.float32)
    radius_offset, left = np.array([max_radius_m, height_offset_m], np.float32), np.array(lanes_m, np.float32)
    _highest(x_m, y_m, z_m, drawn, radius_offset, left, out)
    return np.asarray(np.round(out * np.float32(STEPS_PER_M)) / np.float32(STEPS_PER_M))


@dataclass(frozen=True)
class Contexts:
    """Descriptors (..., 20, 60) in the form in which they are compared."""

    column: I2
    """(..., sectors, rings) columns of length 4095, or 0 where empty."""
    sector_key: F4
    """(..., sectors) mean height of each column, m."""
    ring_key: F4
    """(..., rings) mean height of each ring, m: the same from every heading."""


def contexts(descriptor: F4) -> Contexts:
    """What comparing takes of descriptors (..., 20, 60)."""
    length = np.linalg.norm(descriptor, axis=-2, keepdims=True)
    unit = np.where(length > 0, descriptor / np.maximum(length, np.float32(1e-9)), np.float32(0))
    return Contexts(
        np.ascontiguousarray(np.swapaxes(np.round(LENGTH * unit), -1, -2).astype(np.int16)),
        np.ascontiguousarray(descriptor.mean(axis=-2), np.float32),
        np.ascontiguousarray(descriptor.mean(axis=-1), np.float32),
    )


def descriptor_distance(
    descriptor_i: F4, descriptor_j: F4, shift_share: float = 0.5, alignments: int = 1
) -> tuple[float, float]:
    """Scan context distance (0 same, 1 different) and the heading of j in i, rad, of two descriptors (20, 60).

    Column shifts within `shift_share` of a turn on either side of the best `alignments` of the sector keys are tested.
    """
    i, j = contexts(descriptor_i), contexts(descriptor_j)
    distance, shift = best_distance(
        i.column, j.column, i.sector_key, j.sector_key, shifts_beside(shift_share), alignments
    )
    return float(distance), heading_of(shift)


def shifts_beside(share: float) -> int:
    """Column shifts on either side within a share of the turn; 5 % are 3 of 60."""
    return min(int(np.ceil(share * SECTORS - 1e-9)), SECTORS // 2)


def heading_of(shift: int) -> float:
    """Heading of j in i, rad in [-pi, pi), of a column shift."""
    return float((shift / SECTORS * TAU + np.pi) % TAU - np.pi)


@kernel
def best_distance(
    column_i: I2, column_j: I2, sector_i: F4, sector_j: F4, beside: int, alignments: int
) -> tuple[float, int]:
    """Smallest distance over the shifts around those that align the sector keys best, and its shift.

    Column s of i faces column s - shift of j. All shifts when `beside` is half a turn.
    """
    sectors = len(sector_i)
    if 2 * beside >= sectors:
        return distance_around(column_i, column_j, 0, beside)
    apart = np.zeros(sectors)
    for shift in range(sectors):
        for s in range(sectors):
            e = sector_i[s] - sector_j[s - shift]  # negative indices count from the end
            apart[shift] += e * e
    best, best_shift = 2.0, 0
    for _ in range(alignments):
        middle = int(np.argmin(apart))
        distance, shift = distance_around(column_i, column_j, middle, beside)
        if distance < best:
            best, best_shift = distance, shift
        for k in range(-beside, beside + 1):
            apart[(middle + k) % sectors] = np.inf
    return best, best_shift


@kernel
def distance_around(column_i: I2, column_j: I2, middle: Int, beside: int) -> tuple[float, int]:
    """Smallest mean cosine distance over column shifts within `beside` of `middle`, and its shift; 1 for nearly empty ones."""
    sectors, rings = column_i.shape
    best, best_shift = 1.0, middle % sectors
    for k in range(-beside, beside + 1):
        shift = (middle + k) % sectors
        common: Int = 0
        total: Int = 0
        for s in range(sectors):
            t = s - shift
            if t < 0:
                t += sectors
            dot: Int = 0
            for r in range(rings):
                dot += np.int32(column_i[s, r]) * np.int32(column_j[t, r])
            if dot > 0:
                common += 1
                total += dot
        if common >= LEAST_COMMON_COLUMNS:
            distance = max(1.0 - total / (common * float(LENGTH * LENGTH)), 0.0)
            if distance < best:
                best, best_shift = distance, shift
    return best, best_shift


@kernel
def _highest(x: F4, y: F4, z: F4, drawn: B1, radius_offset: F4, left: F4, out: F4) -> None:
    lanes, rings, sectors = out.shape
    radius, offset = radius_offset[0], radius_offset[1]
    for k in range(len(x)):
        if not drawn[k]:
            continue
        for lane in range(lanes):
            u, v = x[k], y[k] - left[lane]
            r = np.sqrt(u * u + v * v)
            if r < radius:
                ring = min(int(r / radius * np.float32(rings)), rings - 1)
                sector = min(int(turn_of(u, v) * np.float32(sectors)), sectors - 1)
                if z[k] + offset > out[lane, ring, sector]:
                    out[lane, ring, sector] = z[k] + offset
