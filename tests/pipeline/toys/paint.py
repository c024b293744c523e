"""Merges the pieces of a tile."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict

from scanloom.schemas.product import Parts
from tests.pipeline.toys.products import Piece, Tile, TileText

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def paint(settings: Settings, pieces: Parts[Piece]) -> tuple[Tile, TileText]:
    origins = tuple(f"{place['session']}/{place['chunk']}" for place, _ in pieces.items())
    values = np.sort(np.concatenate([piece.value for piece in pieces]))
    return Tile(value=values, origins=origins), TileText(contents={"tile.txt": str(values.tolist()).encode()})
