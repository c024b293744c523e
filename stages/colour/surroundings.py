"""The map around an image: points of the pieces of a session, tile by tile, of which the last few stay in memory."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import RANK_SHIFT, Piece
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.normals import normals
from scanloom.stages.geometry.se3 import F8

STEP_X, STEP_Y = 1 << 29, 1 << 19
"""From one voxel to the next along x and y, in a piece's `voxel`."""


@dataclass(frozen=True)
class Cone:
    """All an image can show, and a little more."""

    tip: F8
    """(3,) where the camera is, in the map's frame, m."""
    axis: F8
    """(3,) unit vector, where it looks."""
    cosine: float
    """Of the widest angle from the axis."""
    reach_m: float


@dataclass(frozen=True)
class Ground:
    """Points of the map in one tile, one per voxel, as far as one session met them."""

    voxel: NDArray[np.int64]
    points: F8
    """(n, 3) in the map's frame, m."""
    normal: NDArray[np.float32]
    """(n, 3) unit normals; zeros where there is no surface."""

    def within(self, cone: Cone) -> NDArray[np.int64]:
        """Rows of the points."""
        return np.flatnonzero(_within(self.points, cone.tip, cone.axis, cone.cosine, cone.reach_m))


@kernel
def _within(points: F8, tip: F8, axis: F8, cosine: float, reach_m: float) -> NDArray[np.bool_]:
    found = np.zeros(len(points), np.bool_)
    for n in range(len(points)):
        x, y, z = points[n, 0] - tip[0], points[n, 1] - tip[1], points[n, 2] - tip[2]
        away = np.sqrt(x * x + y * y + z * z)
        found[n] = away < reach_m and x * axis[0] + y * axis[1] + z * axis[2] >= cosine * away
    return found


class Surroundings:
    """Tiles of a session, read when they are asked for."""

    def __init__(self, pieces: Parts[Piece], held: int) -> None:
        self._pieces = pieces.by("tile") if len(pieces) else {}
        self._held = held
        self._recent: OrderedDict[str, Ground] = OrderedDict()
        example = next(iter(pieces), None)
        self.tile_m = example.tile_size_m if example else 1.0
        self.voxel_m = example.voxel_size_m if example else 1.0
        self._places = {name: _place(name) for name in self._pieces}

    def near(self, place: F8, reach_m: float) -> list[tuple[str, Ground]]:
        """Tiles that come within `reach_m` of a place (3,), by name."""
        names = [
            name for name, at in sorted(self._places.items())
            if np.hypot(*self._off(place[:2], at)) < reach_m
        ]  # fmt: skip
        return [(name, self._tile(name)) for name in names]

    def _off(self, xy: F8, at: tuple[int, int]) -> F8:
        """From a place to the nearest of a tile, along x and y."""
        low = np.array(at) * self.tile_m
        return np.maximum(np.maximum(low - xy, xy - low - self.tile_m), 0.0)

    def _tile(self, name: str) -> Ground:
        if name not in self._recent:
            self._recent[name] = self._read(name)
        self._recent.move_to_end(name)
        while len(self._recent) > self._held:
            self._recent.popitem(last=False)
        return self._recent[name]

    def _read(self, name: str) -> Ground:
        corner = np.array((*self._places[name], 0)) * self.tile_m
        return ground_of(list(self._pieces[name]), corner, self.tile_m)


def ground_of(pieces: list[Piece], corner_m: F8, tile_m: float) -> Ground:
    """Merge the pieces of one tile: what is left out of the map is left out here."""
    of_map = [piece.take(slice(0, int(np.searchsorted(piece.voxel, 1 << RANK_SHIFT)))) for piece in pieces]
    voxel = np.concatenate([piece.voxel for piece in of_map])
    order = np.argsort(voxel, kind="stable")
    voxel = voxel[order]
    starts = np.flatnonzero(np.diff(voxel, prepend=-1))

    def summed(name: str) -> F8:
        values = np.concatenate([getattr(piece, name) for piece in of_map]).astype(float)
        return np.add.reduceat(values[order], starts) if len(starts) else np.empty(0)

    count = summed("count")
    x, y, z = (summed(f"sum_{axis}_m") / count for axis in "xyz")
    view = np.ascontiguousarray(np.concatenate([piece.view for piece in of_map])[order[starts]])
    voxel = np.ascontiguousarray(voxel[starts])
    normal = normals(voxel, x, y, z, view, STEP_X, STEP_Y, 0.5 * tile_m)
    return Ground(voxel, np.column_stack((x, y, z)) + corner_m, normal.astype(np.float32) / 127.0)


def _place(name: str) -> tuple[int, int]:
    x, y = name.split("_")
    return int(x), int(y)
