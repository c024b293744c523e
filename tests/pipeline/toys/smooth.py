"""Rounds the numbers of a chunk to multiples of a step."""

from __future__ import annotations

import dataclasses
import time

from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from tests.pipeline.toys.helper import rounded
from tests.pipeline.toys.products import Chunk, Info, Smooth

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    step: int = Field(1, ge=1, le=10, description="numbers become multiples of it")
    pause_s: float = Field(0.0, ge=0, description="time wasted per item, s")
    refuse: int = Field(-1, description="a number that makes the stage fail")


def smooth(settings: Settings, chunk: Chunk, info: Info) -> Smooth:
    def items():
        for item in chunk:
            time.sleep(settings.pause_s)
            if settings.refuse in item.value:
                raise StageError(f"{settings.refuse} is refused", where=f"item {item.index}")
            yield dataclasses.replace(item, value=rounded(item.value, settings.step))

    return Smooth(items())
