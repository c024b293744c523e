"""One row per item of a session: its sum."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict

from scanloom.schemas.product import Parts
from tests.pipeline.toys.products import Smooth, Track

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def track(settings: Settings, smooth: Parts[Smooth]) -> Track:
    return Track(total=np.array([item.value.sum() for chunk in smooth for item in chunk], dtype=np.int64))
