"""Figures of maps of a few tiles."""

from __future__ import annotations

from typing import Any

from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import RemovedTile, Tile
from scanloom.stages.evaluation.crispness import map_figures
from scanloom.stages.evaluation.survey import Manner

MANNER = Manner(samples=1000, radii_m=(0.3, 0.5, 1.0), least=6, gap_m=(0.05, 0.4))


def parts_of(*tiles: Tile) -> Parts[Any]:
    """Tiles side by side along x."""
    return Parts([((("tile", f"{i}_0"),), tile) for i, tile in enumerate(tiles)])


def map_values(
    *tiles: Tile, removed: tuple[RemovedTile, ...] | None = None, poses: Any = None, manner: Manner = MANNER
) -> dict[str, float]:
    """Figures of a map by their names."""
    out = None if removed is None else parts_of(*removed)
    return {f.name: f.value for f in map_figures(parts_of(*tiles), out, poses or {}, manner)}
