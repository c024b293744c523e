"""The bridge with its abutments."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.scans import PointClass
from scanloom.stages.simulate.meshes import Material, Mesh, box, grid_mesh, joined
from scanloom.stages.simulate.terrain import (
    BRIDGE_X,
    NORTH_Y,
    OPENING,
    deck_height,
)

HALF_WIDTH_M, DECK_M = 4.8, 0.6


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
