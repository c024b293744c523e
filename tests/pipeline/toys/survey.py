"""Looks at all tiles."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from scanloom.schemas.product import Parts
from tests.pipeline.toys.products import Overview, Tile

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def survey(settings: Settings, tiles: Parts[Tile]) -> Overview:
    return Overview(
        tiles=tuple(place["tile"] for place, _ in tiles.items()), count=sum(len(tile) for tile in tiles)
    )
