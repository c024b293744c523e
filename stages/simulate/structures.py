"""The bridge with its abutments, and the tunnel under its hill."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.scans import PointClass
from scanloom.stages.simulate.meshes import Material, Mesh, box, grid_mesh, joined
from scanloom.stages.simulate.terrain import (
    BRIDGE_X,
    NORTH_Y,
    OPENING,
    TUNNEL,
    deck_height,
    height,
    relief,
    smoothstep,
)

HALF_WIDTH_M, DECK_M = 4.8, 0.6
TUNNEL_HALF_M, TUNNEL_TALL_M, HILL_M = 5.0, 5.2, 8.0


def bridge() -> list[tuple[Mesh, PointClass]]:
    """Deck, parapets, abutments and wing walls of the crossing over North Street."""
    y = np.arange(OPENING[0] - 1.5, OPENING[1] + 1.6, 1.0)
    x = BRIDGE_X + np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, 9)
    X, Y = np.meshgrid(x, y)
    top = grid_mesh(x, y, deck_height(X, Y), Material.ASPHALT)
    z = float(deck_height(BRIDGE_X, NORTH_Y))
    low, high = BRIDGE_X - HALF_WIDTH_M, BRIDGE_X + HALF_WIDTH_M
    south, north = OPENING[0] - 1.5, OPENING[1] + 1.5
    parts = [box([low, south, z - DECK_M - 0.3], [high, north, z - 0.35], Material.CONCRETE)]
    for edge in (low, high):
        parts.append(
            box([edge - 0.12, south - 6, z - 0.6], [edge + 0.12, north + 6, z + 0.95], Material.CONCRETE)
        )
    for face in OPENING:
        wall_y = sorted((face, face + (1.2 if face > NORTH_Y else -1.2)))
        parts.append(
            box([BRIDGE_X - 11, wall_y[0], z - 9], [BRIDGE_X + 11, wall_y[1], z - 0.4], Material.CONCRETE)
        )
    return [(top, PointClass.GROUND), (joined(parts), PointClass.STATIC)]


def tunnel() -> list[tuple[Mesh, PointClass]]:
    """Two bare walls and a ceiling, the portals, and the hill above."""
    x = np.arange(TUNNEL[0], TUNNEL[1] + 0.1, 4.0)
    floor = relief(x, np.zeros_like(x))
    rise = np.array([-1.0, TUNNEL_TALL_M])
    parts = []
    for side in (-TUNNEL_HALF_M, TUNNEL_HALF_M):
        flat = grid_mesh(x, rise, floor[None, :] + rise[:, None], Material.CONCRETE)
        parts.append(Mesh(np.column_stack((flat.vertices[:, 0], np.full(len(flat.vertices), side), flat.vertices[:, 2])),
                          flat.triangles, flat.material))  # fmt: skip
    edges = np.array([-TUNNEL_HALF_M, TUNNEL_HALF_M])
    parts.append(grid_mesh(x, edges, np.vstack((floor, floor)) + TUNNEL_TALL_M, Material.CONCRETE))
    for lamp in np.arange(TUNNEL[0] + 9, TUNNEL[1], 18.0):
        z = float(relief(np.array(lamp), np.array(0.0))) + TUNNEL_TALL_M
        parts.append(box([lamp - 0.5, -0.2, z - 0.15], [lamp + 0.5, 0.2, z], Material.METAL))
    return [(joined([*parts, *_portals()]), PointClass.STATIC), (_hill(), PointClass.GROUND)]


def _hilltop(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return height(x, y) + HILL_M * (1 - smoothstep((np.abs(y) - 8) / 27)) + 0.2


def _hill() -> Mesh:
    x, y = np.arange(TUNNEL[0], TUNNEL[1] + 0.1, 2.0), np.arange(-36.0, 36.1, 2.0)
    X, Y = np.meshgrid(x, y)
    return grid_mesh(x, y, _hilltop(X, Y), Material.GRASS)


def _portals() -> list[Mesh]:
    """Walls between the ground, or the ceiling over the road, and the top of the hill."""
    out = []
    y = np.concatenate((np.arange(-36, -5, 1.0), [-5.0, 5.0], np.arange(6, 36.1, 1.0)))
    for x in TUNNEL:
        at = np.full(len(y), x)
        top, ground = _hilltop(at, y), height(at, y) - 1.0
        ceiling = float(relief(np.array(x), np.array(0.0))) + TUNNEL_TALL_M
        for i in range(len(y) - 1):
            over_road = abs(y[i] + y[i + 1]) < 0.5
            low = (ceiling, ceiling) if over_road else (ground[i], ground[i + 1])
            vertices = np.array(
                [[x, y[i], low[0]], [x, y[i + 1], low[1]], [x, y[i + 1], top[i + 1]], [x, y[i], top[i]]]
            )
            out.append(
                Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, Material.CONCRETE, np.uint8))
            )
    return out
