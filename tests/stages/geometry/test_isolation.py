"""Isolated points of random scans: as a slow search through the image says; edges of what a scan can be."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scanloom.stages.geometry.isolation import ALONGSIDE, FARTHEST_COLUMNS, FARTHEST_ROWS, isolated
from scanloom.stages.geometry.range_image import ImageSettings, range_image

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
REACH_M, REACH_RAD = 0.2, 0.02


def found(p: F4, least: int = 2) -> B1:
    x, y, z = (np.ascontiguousarray(c) for c in p.T)
    image = range_image(ImageSettings(rows=32, columns=720), x, y, z, *[np.isfinite(p).all(axis=1)] * 2)
    return isolated(image, x, y, z, reach_m=REACH_M, reach_rad=REACH_RAD, least_neighbours=least)


def slow(p: F4, least: int) -> B1:
    """The same, point by point."""
    x, y, z = (np.ascontiguousarray(c) for c in p.T)
    image = range_image(ImageSettings(rows=32, columns=720), x, y, z, *[np.isfinite(p).all(axis=1)] * 2)
    rows, columns = image.point.shape
    row_rad = np.median(np.diff(image.elevation_rad)) if rows > 1 else np.pi
    out = np.zeros(len(p), np.bool_)
    for n in np.flatnonzero(image.cell >= 0):
        r = np.float32(np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n]))
        reach = max(np.float32(REACH_M), np.float32(REACH_RAD) * r)
        others = [
            m
            for m in range(max(n - ALONGSIDE, 0), min(n + ALONGSIDE + 1, len(p)))
            if m != n and image.cell[m] >= 0
        ]
        # the earlier of two points says how far apart they may be
        far = [np.maximum(REACH_M, REACH_RAD * np.linalg.norm(p[min(m, n)])) for m in others]
        if sum(np.abs(p[m] - p[n]).max() < f for m, f in zip(others, far)) >= least:
            continue
        v, u = divmod(int(image.cell[n]), columns)
        up = min(int(reach / (r * row_rad) + 0.5), FARTHEST_ROWS)
        aside = min(int(reach / (r * image.column_rad) + 0.5), FARTHEST_COLUMNS, (columns - 1) // 2)
        around = image.range_m[max(v - up, 0) : v + up + 1][:, np.arange(u - aside, u + aside + 1) % columns]
        near = np.count_nonzero((around > 0) & (np.abs(around - r) < reach))
        out[n] = near - (abs(image.range_m[v, u] - r) < reach) < least
    return out


@pytest.mark.parametrize("least", [1, 2, 5])
def test_as_a_slow_search_says(least: int) -> None:
    rng = np.random.default_rng(least)
    turn = np.sort(rng.uniform(0, 2 * np.pi, 4000))
    up = rng.choice(np.radians(np.arange(-15, 6, 2.0)), 4000)
    away = np.where(rng.random(4000) < 0.5, 12.0 + np.sin(3 * turn), rng.uniform(1.0, 60.0, 4000))
    p = np.stack((np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)), axis=1) * away[:, None]
    p = p.astype(np.float32)
    p[::97] = np.nan
    p[5], p[6] = 0.0, (np.nan, 1.0, 1.0)
    lonely = found(p, least)
    assert 0.1 < lonely.mean() < 0.96
    np.testing.assert_array_equal(lonely, slow(p, least))


def test_a_wall_has_neighbours_round_the_seam_and_a_flake_before_it_none() -> None:
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    p = np.stack((10 * np.cos(turn), 10 * np.sin(turn), np.zeros(720)), axis=1).astype(np.float32)
    p[300] *= 0.5
    rng = np.random.default_rng(0)
    order = rng.permutation(720)  # no help from what was measured before and after
    lonely = found(p[order])
    np.testing.assert_array_equal(np.flatnonzero(lonely), np.flatnonzero(order == 300))


@pytest.mark.parametrize("p", [np.zeros((0, 3)), np.ones((1, 3)), np.zeros((1, 3)), np.full((3, 3), np.nan)])
def test_scans_of_hardly_anything(p: NDArray[np.float64]) -> None:
    lonely = found(p.astype(np.float32))
    assert len(lonely) == len(p)
    assert lonely.sum() == (len(p) == 1 and p.any())
