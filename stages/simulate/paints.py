"""What colour things have: of every material and object, at every place of it. The same for LiDAR and cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.meshes import Material

F4 = NDArray[np.float32]
I8 = NDArray[np.int64]

_COLOURS = np.array(
    [
        (0.105, 0.105, 0.11), (0.62, 0.62, 0.58), (0.27, 0.255, 0.23), (0.075, 0.13, 0.035), (0.6, 0.55, 0.44),
        (0.3, 0.1, 0.06), (0.33, 0.32, 0.3), (0.035, 0.05, 0.06), (0.27, 0.085, 0.05), (0.11, 0.075, 0.05),
        (0.06, 0.13, 0.03), (0.04, 0.045, 0.06), (0.62, 0.62, 0.62), (0.02, 0.02, 0.02), (0.2, 0.17, 0.2),
        (0.3, 0.31, 0.32), (0.75, 0.72, 0.7), (0.35, 0.29, 0.2), (0.85, 0.87, 0.9), (0.05, 0.06, 0.06),
    ],
    np.float32,
)  # fmt: skip
"""Share of red, green and blue light that comes back, by `Material`."""
_PLASTERS = (
    (0.66, 0.62, 0.52),
    (0.6, 0.45, 0.25),
    (0.45, 0.5, 0.42),
    (0.62, 0.4, 0.32),
    (0.7, 0.69, 0.66),
    (0.35, 0.4, 0.47),
)
_BRICKS = ((0.3, 0.1, 0.06), (0.2, 0.09, 0.07), (0.38, 0.27, 0.16), (0.26, 0.13, 0.1))
_DARKS = (
    (0.02, 0.02, 0.025),
    (0.02, 0.035, 0.11),
    (0.12, 0.015, 0.015),
    (0.015, 0.05, 0.03),
    (0.05, 0.05, 0.055),
)
_LIGHTS = ((0.7, 0.7, 0.69), (0.5, 0.05, 0.04), (0.55, 0.4, 0.06), (0.3, 0.42, 0.52), (0.45, 0.45, 0.44))  # fmt: skip
_CLOTHES = ((0.05, 0.06, 0.12), (0.45, 0.08, 0.07), (0.5, 0.45, 0.12), (0.1, 0.22, 0.12), (0.5, 0.5, 0.5))
_PALETTES = {
    Material.PLASTER: _PLASTERS,
    Material.BRICK: _BRICKS,
    Material.PAINT_DARK: _DARKS,
    Material.PAINT_LIGHT: _LIGHTS,
    Material.CLOTH: _CLOTHES,
}
_SIDE = 512
_FLAT = (Material.ASPHALT, Material.MARKING, Material.GRASS)
_ROUGH = {
    Material.ASPHALT: (0.1, 0.18), Material.MARKING: (0.15, 0.25), Material.PAVING: (0.08, 0.1), Material.GRASS: (0.25, 0.3),
    Material.PLASTER: (0.03, 0.14), Material.CONCRETE: (0.06, 0.16), Material.ROOF: (0.12, 0.12), Material.BARK: (0.2, 0.1),
    Material.LEAF: (0.3, 0.3), Material.BRICK: (0.08, 0.1), Material.METAL: (0.02, 0.04), Material.CLOTH: (0.05, 0.05),
}  # fmt: skip
"""How much brightness varies from spot to spot (4 cm) and from patch to patch (0.8 m), as standard deviations."""
_SPOT_M, _PATCH_M = 0.04, 0.8
_BRICK_M, _JOINT_M = (0.25, 0.08), 0.011
_SLAB_M, _GAP_M = 0.4, 0.008


class Paints:
    """The colours of one town."""

    def __init__(self, town_seed: int) -> None:
        rng = np.random.default_rng((town_seed, 30))
        self._fine = rng.standard_normal((_SIDE, _SIDE), np.float32).clip(-2.0, 2.0)
        coarse = rng.standard_normal((_SIDE // 8, _SIDE // 8), np.float32).clip(-1.5, 1.5)
        self._coarse = _smooth(coarse)
        self._shuffle = rng.permutation(4096)

    def albedo(self, material: NDArray[np.uint8], tint: I8, points: F8) -> F4:
        """Share (n, 3) of red, green and blue light that comes back.

        `tint` (n,) is the number of the object, 0 for none; `points` (n, 3) m are fixed to it: in the world for what
        stands, in the object's own frame for what moves.
        """
        colour = _COLOURS[material].copy()
        across, up = points[:, 0] + points[:, 1], points[:, 2]
        for kind in np.unique(material).tolist():
            rows = np.flatnonzero(material == kind)
            flat = kind in _FLAT or kind == Material.PAVING
            u, v = (points[rows, 0], points[rows, 1]) if flat else (across[rows], up[rows])
            if kind in _PALETTES:
                palette = np.array(_PALETTES[Material(kind)], np.float32)
                colour[rows] = palette[self._shuffle[(7 * tint[rows] + kind) % 4096] % len(palette)]
            if kind == Material.BRICK:
                self._lay_bricks(colour, rows, u, v)
            if kind == Material.PAVING:
                joint = (np.mod(u, _SLAB_M) < _GAP_M) | (np.mod(v, _SLAB_M) < _GAP_M)
                colour[rows[joint]] *= np.float32(0.5)
            if kind == Material.ROOF:
                colour[rows] *= np.where(np.mod(v, 0.18) < 0.03, 0.6, 1.0).astype(np.float32)[:, None]
            if kind in _ROUGH:
                colour[rows] *= self._rough(u, v, *_ROUGH[Material(kind)])[:, None]
        return np.clip(colour, 0.01, 0.95)

    def _lay_bricks(self, colour: F4, rows: I8, u: F8, v: F8) -> None:
        """Bricks in bond, each of its own shade, between joints of mortar."""
        course = np.floor(v / _BRICK_M[1])
        shifted = u + 0.5 * _BRICK_M[0] * np.mod(course, 2)
        brick = np.floor(shifted / _BRICK_M[0])
        pick = self._shuffle[(brick.astype(np.int64) * 31 + course.astype(np.int64) * 17) % 4096] / 4096
        colour[rows] *= (0.75 + 0.5 * pick).astype(np.float32)[:, None]
        mortar = (np.mod(v, _BRICK_M[1]) < _JOINT_M) | (np.mod(shifted, _BRICK_M[0]) < _JOINT_M)
        colour[rows[mortar]] = (0.42, 0.4, 0.37)

    def _rough(self, u: F8, v: F8, spots: float, patches: float) -> F4:
        fine = self._fine[_cell(v, _SPOT_M), _cell(u, _SPOT_M)]
        step = _PATCH_M / 8
        coarse = self._coarse[_cell(v, step), _cell(u, step)]
        return np.maximum(1.0 + np.float32(spots) * fine + np.float32(patches) * coarse, np.float32(0.3))


def _cell(x: F8, step_m: float) -> I8:
    return np.asarray(np.floor(x / step_m).astype(np.int64) % _SIDE)


def _smooth(coarse: F4) -> F4:
    """Eight times as fine, straight between the values, the same at opposite edges."""
    for axis in (0, 1):
        ahead = np.roll(coarse, -1, axis)
        steps = np.arange(8, dtype=np.float32) / 8
        mixed = np.stack([(1 - s) * coarse + s * ahead for s in steps], axis=axis + 1)
        shape = list(coarse.shape)
        shape[axis] *= 8
        coarse = mixed.reshape(shape)
    return coarse
