"""Triangle meshes of the things a town is made of, in their own frames (x forward, y left, z up, metres)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.stages.geometry.se3 import F8


class Material(IntEnum):
    """What a surface is made of."""

    ASPHALT = 0
    MARKING = 1
    PAVING = 2
    GRASS = 3
    PLASTER = 4
    BRICK = 5
    CONCRETE = 6
    GLASS = 7
    ROOF = 8
    BARK = 9
    LEAF = 10
    PAINT_DARK = 11
    PAINT_LIGHT = 12
    RUBBER = 13
    CLOTH = 14
    METAL = 15
    RETRO = 16
    DUST = 17
    SNOW = 18
    WATER = 19


REFLECTIVITY = np.array(
    [
        0.11,
        0.55,
        0.28,
        0.32,
        0.55,
        0.33,
        0.38,
        0.06,
        0.25,
        0.22,
        0.42,
        0.07,
        0.45,
        0.05,
        0.35,
        0.4,
        4.0,
        0.12,
        0.9,
        0.12,
    ],
    np.float32,
)
"""Share of the light that comes back at normal incidence, by `Material`; retro-reflectors focus it."""


@dataclass(frozen=True)
class Mesh:
    """Vertices (n, 3) m, triangles (m, 3) as vertex numbers, material (m,) of each triangle."""

    vertices: F8
    triangles: NDArray[np.int64]
    material: NDArray[np.uint8]

    def moved(self, xyz: ArrayLike, yaw_rad: float = 0.0) -> Mesh:
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turned = self.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        return Mesh(turned + np.asarray(xyz, float), self.triangles, self.material)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + o for m, o in zip(meshes, offsets)]),
        np.concatenate([m.material for m in meshes]),
    )


def _mesh(vertices: ArrayLike, triangles: ArrayLike, material: Material) -> Mesh:
    faces = np.asarray(triangles, np.int64)
    return Mesh(np.asarray(vertices, float), faces, np.full(len(faces), material, np.uint8))


_BOX = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6],
        [1, 3, 5], [3, 7, 5]]  # fmt: skip


def box(low: ArrayLike, high: ArrayLike, material: Material, taper: float = 1.0) -> Mesh:
    """Box between two corners; the top is `taper` times as long and wide as the bottom."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    middle = (a + b) / 2
    corners = np.array([[x, y, z] for z in (a[2], b[2]) for y in (a[1], b[1]) for x in (a[0], b[0])])
    corners[4:, :2] = middle[:2] + taper * (corners[4:, :2] - middle[:2])
    return _mesh(corners, _BOX, material)


def quad(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike, material: Material) -> Mesh:
    return _mesh(np.array([a, b, c, d], float), [[0, 1, 2], [0, 2, 3]], material)


def cylinder(foot: ArrayLike, top: ArrayLike, radius_m: float, material: Material, sides: int = 8) -> Mesh:
    """Open tube from `foot` to `top`."""
    p, q = np.asarray(foot, float), np.asarray(top, float)
    axis = (q - p) / np.linalg.norm(q - p)
    u = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius_m * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.cross(axis, u))
    k = np.arange(sides)
    n = (k + 1) % sides
    faces = np.concatenate((np.column_stack((k, n, k + sides)), np.column_stack((n, n + sides, k + sides))))
    return _mesh(np.concatenate((p + ring, q + ring)), faces, material)


def ball(centre: ArrayLike, radii: ArrayLike, material: Material) -> Mesh:
    """Octahedron, refined once."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    vertices: list[F8] = []
    for i, j, k in ((0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)):
        a, b, c = corners[i], corners[j], corners[k]
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q) for p, q in ((a, b), (b, c), (c, a)))
        vertices += [a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca]
    points = np.array(vertices) * np.asarray(radii, float) + np.asarray(centre, float)
    return _mesh(points, np.arange(len(points)).reshape(-1, 3), material)


def grid_mesh(x: F8, y: F8, z: F8, material: Material) -> Mesh:
    """Surface z (rows, columns) over the coordinates y (rows,) and x (columns,)."""
    X, Y = np.meshgrid(x, y)
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate((np.stack((a, b, c), -1).reshape(-1, 3), np.stack((a, c, d), -1).reshape(-1, 3)))
    return _mesh(np.column_stack((X.ravel(), Y.ravel(), z.ravel())), faces, material)


def leaves(rng: np.random.Generator, centre: ArrayLike, radii: ArrayLike, count: int, size_m: float) -> Mesh:
    """Triangles scattered in an ellipsoid, denser towards its skin; rays partly pass."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    spot = direction * rng.uniform(0.25, 1.0, (count, 1)) ** 0.5 * np.asarray(radii, float) + np.asarray(
        centre, float
    )
    corners = spot[:, None, :] + size_m * rng.standard_normal((count, 3, 3))
    return _mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), Material.LEAF)


def tree(rng: np.random.Generator) -> Mesh:
    """Trunk and one to three tufts of leaves."""
    tall, crown = rng.uniform(2.2, 3.6), rng.uniform(1.4, 2.6)
    parts = [cylinder([0, 0, -0.5], [0, 0, tall + crown], rng.uniform(0.1, 0.22), Material.BARK)]
    for _ in range(rng.integers(1, 4)):
        centre = [*rng.uniform(-0.5, 0.5, 2), tall + crown * rng.uniform(0.6, 1.1)]
        parts.append(leaves(rng, centre, [crown, crown, crown * rng.uniform(0.7, 1.2)], 420, 0.09))
    return joined(parts)


def bush(rng: np.random.Generator) -> Mesh:
    radius = rng.uniform(0.4, 1.0)
    return leaves(rng, [0, 0, 0.8 * radius], [radius, radius, 0.9 * radius], int(260 * radius), 0.07)


def hedge(rng: np.random.Generator, length_m: float) -> Mesh:
    tall = rng.uniform(0.9, 1.6)
    count = int(220 * length_m)
    spot = rng.uniform([-length_m / 2, -0.3, 0], [length_m / 2, 0.3, tall], (count, 3))
    corners = spot[:, None, :] + 0.06 * rng.standard_normal((count, 3, 3))
    return _mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), Material.LEAF)


def house(rng: np.random.Generator, width_m: float, depth_m: float, tall_m: float) -> Mesh:
    """Block with gable roof, windows and a porch or balcony; the front is at y = 0, the body towards +y."""
    wall = Material(int(rng.choice([Material.PLASTER, Material.BRICK, Material.CONCRETE])))
    w, ridge = width_m / 2, tall_m + rng.uniform(1.5, 3.0)
    parts = [box([-w, 0, -4.0], [w, depth_m, tall_m], wall)]
    eave = 0.35
    roof = [[-w, -eave, tall_m], [w, -eave, tall_m], [-w, depth_m + eave, tall_m], [w, depth_m + eave, tall_m],
            [-w, depth_m / 2, ridge], [w, depth_m / 2, ridge]]  # fmt: skip
    parts.append(
        _mesh(roof, [[0, 1, 5], [0, 5, 4], [2, 4, 5], [2, 5, 3], [0, 4, 2], [1, 3, 5]], Material.ROOF)
    )
    pitch = rng.uniform(2.2, 3.4)
    for floor in np.arange(0.9, tall_m - 1.6, 2.9):
        for x in np.arange(-w + 0.9, w - 1.6, pitch):
            pane = Material.GLASS if rng.random() < 0.6 else Material.PLASTER
            parts.append(box([x - 0.08, -0.12, floor - 0.1], [x + 1.25, 0.0, floor + 1.45], pane))
    if rng.random() < 0.6:
        x, out, z = rng.uniform(-w, w - 2.5), rng.uniform(0.6, 1.5), rng.choice([0.0, 2.8])
        parts.append(box([x, -out, z - 1.0 if z == 0 else z], [x + 2.4, 0, z + rng.uniform(1.0, 2.4)], wall))
    parts.append(
        box(
            [w * 0.3, depth_m * 0.4, tall_m],
            [w * 0.3 + 0.6, depth_m * 0.4 + 0.6, ridge + 0.8],
            Material.BRICK,
        )
    )
    return joined(parts)


def lamp() -> Mesh:
    return joined(
        [
            cylinder([0, 0, -0.5], [0, 0, 6.0], 0.08, Material.METAL),
            cylinder([0, 0, 5.9], [0, -1.4, 6.2], 0.05, Material.METAL, 5),
            box([-0.15, -1.8, 6.1], [0.15, -1.2, 6.25], Material.METAL),
        ]
    )


def sign() -> Mesh:
    return joined(
        [
            cylinder([0, 0, -0.5], [0, 0, 2.6], 0.035, Material.METAL, 6),
            box([-0.03, -0.3, 2.0], [0.0, 0.3, 2.6], Material.RETRO),
        ]
    )


def car(paint: Material, length_m: float = 4.3, tall_m: float = 1.48) -> Mesh:
    """Body, cabin, wheels, number plates; the origin is on the ground below the middle."""
    f = length_m / 2
    parts = [
        box([-f, -0.88, 0.3], [f, 0.88, 0.85], paint, 0.97),
        box([-f + 0.25, -0.8, 0.84], [f - 1.15, 0.8, tall_m - 0.08], Material.GLASS, 0.82),
        box([-f + 0.6, -0.66, tall_m - 0.1], [f - 1.5, 0.66, tall_m], paint),
        box([f, -0.26, 0.45], [f + 0.02, 0.26, 0.57], Material.RETRO),
        box([-f - 0.02, -0.26, 0.6], [-f, 0.26, 0.72], Material.RETRO),
    ]
    for x in (-f + 0.8, f - 0.8):
        parts += [
            box([x - 0.32, y - 0.1, 0.0], [x + 0.32, y + 0.1, 0.64], Material.RUBBER) for y in (-0.75, 0.75)
        ]
    return joined(parts)


def truck() -> Mesh:
    parts = [
        box([2.0, -1.15, 0.5], [4.0, 1.15, 2.7], Material.PAINT_LIGHT, 0.95),
        box([3.95, -1.0, 1.6], [4.02, 1.0, 2.5], Material.GLASS),
        box([-4.0, -1.25, 0.9], [1.8, 1.25, 3.3], Material.METAL),
    ]
    for x in (-3.0, -1.8, 3.0):
        parts += [box([x - 0.5, y - 0.15, 0], [x + 0.5, y + 0.15, 1.0], Material.RUBBER) for y in (-1.0, 1.0)]
    return joined(parts)


def person(stride: float = 0.25) -> Mesh:
    return joined(
        [
            cylinder([stride, 0.1, 0], [0, 0.1, 0.85], 0.08, Material.CLOTH, 6),
            cylinder([-stride, -0.1, 0], [0, -0.1, 0.85], 0.08, Material.CLOTH, 6),
            cylinder([0, 0, 0.8], [0, 0, 1.5], 0.2, Material.CLOTH),
            ball([0, 0, 1.64], [0.11, 0.1, 0.14], Material.CLOTH),
        ]
    )


def cyclist() -> Mesh:
    parts = [person(0.1).moved([0, 0, 0.25])]
    parts += [box([x - 0.33, -0.02, 0], [x + 0.33, 0.02, 0.66], Material.RUBBER) for x in (-0.52, 0.52)]
    parts.append(cylinder([-0.5, 0, 0.35], [0.5, 0, 0.8], 0.03, Material.METAL, 5))
    return joined(parts)


def bus() -> Mesh:
    parts = [
        box([-5.6, -1.25, 0.35], [5.6, 1.25, 1.2], Material.PAINT_LIGHT),
        box([-5.55, -1.22, 1.2], [5.55, 1.22, 2.4], Material.GLASS),
        box([-5.6, -1.25, 2.4], [5.6, 1.25, 3.0], Material.PAINT_LIGHT, 0.98),
    ]
    parts += [box([x - 0.06, y - 0.02, 1.2], [x + 0.06, y + 0.02, 2.4], Material.PAINT_DARK)
              for x in np.arange(-5.2, 5.3, 1.3) for y in (-1.23, 1.23)]  # fmt: skip
    for x in (-3.4, 2.9):
        parts += [box([x - 0.5, y - 0.15, 0], [x + 0.5, y + 0.15, 1.0], Material.RUBBER) for y in (-1.1, 1.1)]
    return joined(parts)


def dog() -> Mesh:
    parts = [box([-0.3, -0.11, 0.26], [0.3, 0.11, 0.52], Material.CLOTH, 0.9)]
    parts.append(ball([0.4, 0, 0.58], [0.14, 0.09, 0.1], Material.CLOTH))
    parts += [box([x - 0.03, y - 0.03, 0], [x + 0.03, y + 0.03, 0.27], Material.CLOTH)
              for x in (-0.25, 0.25) for y in (-0.07, 0.07)]  # fmt: skip
    return joined(parts)


def pram() -> Mesh:
    parts = [box([-0.4, -0.22, 0.45], [0.4, 0.22, 0.8], Material.CLOTH, 1.1)]
    parts.append(cylinder([-0.4, 0, 0.75], [-0.7, 0, 1.0], 0.02, Material.METAL, 5))
    parts.append(ball([0.2, 0, 0.85], [0.25, 0.22, 0.25], Material.CLOTH))
    parts += [box([x - 0.13, y - 0.02, 0], [x + 0.13, y + 0.02, 0.26], Material.RUBBER)
              for x in (-0.3, 0.3) for y in (-0.25, 0.25)]  # fmt: skip
    return joined(parts)
