"""Makes a log from a seed, for sessions that bring none."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tests.pipeline.toys.products import Log

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    seed: int = Field(0, ge=0, description="seed of the generator")


def make(settings: Settings) -> Log:
    values = np.random.default_rng(settings.seed).integers(0, 40, 30)
    return Log(contents={"log.txt": "\n".join(map(str, values)).encode()})
