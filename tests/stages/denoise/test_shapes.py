"""Shapes of all cells at once, against each point by itself."""

from __future__ import annotations

import numpy as np

from scanloom.stages.denoise.frame import Frame
from scanloom.stages.denoise.shapes import COUNTS, FLAT, SURFACE, cell_shapes, shapes_of
from scanloom.stages.geometry.range_image import ImageSettings, range_image


def street(seed: int) -> Frame:
    """A frame of level ground, walls and strays, some points of which lie in a cell with a nearer one."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 400, endpoint=False), np.radians(np.arange(-20.0, 5.0, 1.0))
    )
    azimuth = (azimuth + 0.3 * rng.uniform(-1, 1, azimuth.shape) * np.pi / 200).ravel()
    elevation = elevation.ravel()
    with np.errstate(divide="ignore"):
        ground = np.where(elevation < 0.0, -1.8 / np.sin(elevation), np.inf)
    wall = 12.0 / np.maximum(abs(np.cos(azimuth)), 0.2)
    r = np.minimum(ground, wall) * (1.0 + 0.001 * rng.normal(size=len(wall)))
    stray = rng.random(len(r)) < 0.1
    r[stray] *= rng.uniform(0.2, 1.0, stray.sum())
    kept = rng.random(len(r)) < 0.9
    way = np.column_stack(
        (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    )
    points = (r[:, None] * way)[kept].astype(np.float32)
    all_ = np.ones(len(points), bool)
    columns = [np.ascontiguousarray(c) for c in points.T]
    image = range_image(ImageSettings(), *columns, all_, all_)
    return Frame.of(image, *columns)


def alone(frame: Frame, k: int, r: float) -> int:
    """Shape of a point at range r in cell k."""
    around = [frame.range_m[k + i * frame.stride + j] for i in (-1, 0, 1) for j in range(-2, 3)]
    near = sum(bool(abs(a - r) < max(0.3, 0.02 * r)) for a in around) - 1
    noise, offs = 0.05 + 0.005 * r, []
    for d in (1, 2, frame.stride - 1, frame.stride, frame.stride + 1):
        a, b = float(frame.range_m[k + d]), float(frame.range_m[k - d])
        offs.append(abs(2 * a * b / (a + b) - r) if a * b < np.inf else np.inf)
    straight = sum(off < noise for off in offs)
    lines = 1 + min(straight, 4) if min(offs) < 5.0 * noise else 0
    shape = lines * COUNTS + sum(near >= edge for edge in (1, 2, 4, 8))
    return shape + FLAT * (offs[0] < noise)


def test_shapes_of_cells_are_those_of_their_points_by_themselves() -> None:
    frame = street(1)
    asked = np.flatnonzero(frame.place >= 0)
    hidden = frame.range_m[frame.place[asked]] != frame.away_m[asked]
    assert 50 < hidden.sum() < 0.5 * len(asked)
    found = shapes_of(frame.place, frame.away_m, frame.range_m, frame.stride, cell_shapes(frame), asked)
    expected = [alone(frame, int(frame.place[n]), float(frame.away_m[n])) for n in asked]
    differ = found != expected
    assert differ.mean() < 0.001  # at an edge single precision decides
    assert not differ[hidden].any()
    assert len(np.unique(found & (FLAT - 1))) >= 25
    assert (found & (FLAT - 1)).max() == SURFACE
    assert 0.3 < (found >= FLAT).mean() < 0.99
