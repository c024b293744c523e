"""Sorts the shifted numbers of a chunk into tiles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Part
from tests.pipeline.toys.products import Piece, Shift, Smooth

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    width: int = Field(10, ge=1, description="numbers per tile")
    refuse: int = Field(-1, description="a number that makes the stage fail")


def cut(settings: Settings, smooth: Smooth, shift: Shift) -> Iterator[Part[Piece]]:
    values = np.concatenate([item.value for item in smooth]) + shift.value[0]
    if settings.refuse in values:
        raise StageError(f"{settings.refuse} is refused")
    for tile in np.unique(values // settings.width):
        yield Part(Piece(value=values[values // settings.width == tile]), f"{tile}_0")
