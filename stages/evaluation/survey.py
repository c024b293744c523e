"""A look at one tile: everything that the figures of the map need of it, in one pass, and little to remember.

Figures of neighbourhoods are taken at a sample of the points, at most so many a tile, evenly along the rows; each stands for
as many points as were passed over. A tile's sample thus depends on that tile alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import RemovedTile, Tile
from scanloom.stages.evaluation.layers import LEAST_POINTS, RADIUS_M, patches
from scanloom.stages.evaluation.passes import Passes
from scanloom.stages.geometry.entropy import entropies
from scanloom.stages.geometry.neighbourhoods import Columns, covariances, moments
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
I8 = NDArray[np.int64]

UPRIGHT = 0.25
"""Largest height of the unit normal of an upright surface: 14 degrees out of plumb."""
FLAT = 0.25
"""A surface is thinner than half of its width: its least variance is below this share of the middle one."""


@dataclass(frozen=True)
class Manner:
    """How tiles are looked at."""

    samples: int
    """At most, of each tile."""
    radii_m: tuple[float, ...]
    """Increasing."""
    least: int
    """Points a neighbourhood needs."""
    gap_m: tuple[float, float]
    """Least and largest distance of the layers of a double wall."""


@dataclass(frozen=True)
class Survey:
    """What is kept of a tile. Samples (m,) stand for `weight` points each."""

    points: int
    returns: int
    """Measured points averaged in them."""
    squares: int
    """Of 1 m that hold a point, seen from above."""
    again_squares: int
    """Those of them with a point that was met again on a later pass."""
    again: int
    """Points met again on a later pass, as far as the stamps tell."""
    other: int
    """Points met again by another session."""
    ground: I8
    """How many squares of 1 m (k,) have 0, 1, 2, ... points of class ground, those without any ground left out."""
    weight: F4
    entropy: F4
    """(m, radii)"""
    blurred: F4
    """(m,) entropy at the middle radius with what was left out of the map; NaN where nothing of it lies in the tile."""
    variance: F4
    """(m,) least variance at the middle radius, m2."""
    density: F4
    """(m,) points within the middle radius per m2 of a surface; NaN where there is none."""
    patch: NDArray[np.uint8]
    """(p,) kinds of patches of upright surfaces."""
    patch_weight: F4
    measured: F4
    """(p, 3) of the patches."""


def survey(tile: Tile, removed: RemovedTile | None, passes: Passes, manner: Manner) -> Survey:
    """Look at one tile; neighbours across its border are not seen."""
    points = np.column_stack((tile.x_m, tile.y_m, tile.z_m))
    square = _squares(points)
    again, other = passes.met_again(tile)
    columns = Columns(points, max(manner.radii_m[-1], RADIUS_M))
    rows = _sample(len(tile), manner.samples)
    radii = np.array(manner.radii_m)
    found = moments(columns, points[rows], radii)
    middle = len(radii) // 2
    sigma, enough = covariances(found[:, middle]), found[:, middle, 0] >= manner.least
    variance = np.linalg.eigvalsh(np.where(enough[:, None, None], sigma, np.eye(3)))
    flat = enough & (variance[:, 0] < FLAT * variance[:, 1])
    weight = np.full(len(rows), len(tile) / max(len(rows), 1), np.float32)
    patch_rows, patch, measured = _walls(tile, columns, points[rows], found[:, -1], manner)
    return Survey(
        points=len(tile),
        returns=int(tile.count.sum()),
        squares=_filled(square),
        again_squares=_filled(square[again]),
        again=int(again.sum()),
        other=int(other.sum()),
        ground=_ground(square[tile.class_ == PointClass.GROUND]),
        weight=weight,
        entropy=entropies(found, manner.least).astype(np.float32),
        blurred=_blurred(removed, points[rows], found[:, middle], radii[middle], manner.least),
        variance=np.where(enough, variance[:, 0], np.nan).astype(np.float32),
        density=np.where(flat, found[:, middle, 0] / (np.pi * radii[middle] ** 2), np.nan).astype(np.float32),
        patch=patch,
        patch_weight=weight[patch_rows],
        measured=measured.astype(np.float32),
    )


def _sample(points: int, samples: int) -> I8:
    """Rows evenly along all rows, each once."""
    m = min(points, samples)
    return ((2 * np.arange(m, dtype=np.int64) + 1) * points) // (2 * max(m, 1))


def _blurred(removed: RemovedTile | None, queries: F4, kept: F8, radius_m: float, least: int) -> F4:
    """Entropy (m,) with what was left out around the queries: its moments on top of those of the map."""
    if removed is None:
        return np.full(len(queries), np.nan, np.float32)
    if not len(removed):
        return entropies(kept, least).astype(np.float32)
    gone = np.column_stack((removed.x_m, removed.y_m, removed.z_m))
    added = moments(Columns(gone, radius_m), queries, np.array([radius_m]))[:, 0]
    return entropies(kept + added, least).astype(np.float32)


def _walls(
    tile: Tile, columns: Columns, queries: F4, moments: F8, manner: Manner
) -> tuple[I8, NDArray[np.uint8], F8]:
    """Samples in the middle of an upright surface, what kind of patch it is, and what was measured of it."""
    many = np.flatnonzero(moments[:, 0] >= LEAST_POINTS)
    variance, axes = np.linalg.eigh(covariances(moments[many]))
    upright = (np.abs(axes[:, 2, 0]) < UPRIGHT) & (variance[:, 0] < FLAT * variance[:, 1])
    rows, normals = many[upright], np.ascontiguousarray(axes[upright, :, 0])
    facing, first_ns = tile.normal[columns.order], tile.first_ns[columns.order]
    kind, measured = patches(columns, facing, first_ns, queries[rows], normals, manner.gap_m)
    return rows, kind, measured


def _squares(points: F4) -> I8:
    """Number (n,) of the square of 1 m that each point lies in, from the lowest corner of all."""
    if not len(points):
        return np.empty(0, np.int64)
    column, row = np.floor(points[:, 0]).astype(np.int64), np.floor(points[:, 1]).astype(np.int64)
    column, row = column - column.min(), row - row.min()
    square: I8 = column * (row.max() + 1) + row
    return square


def _filled(square: I8) -> int:
    """How many different squares there are among them."""
    return int(np.count_nonzero(np.bincount(square)))


def _ground(square: I8) -> I8:
    """How many squares have 0, 1, 2, ... of the points whose squares are given; those without any do not count."""
    counts = np.bincount(square)
    return np.bincount(counts[counts > 0])
