"""Puts the sessions side by side: a shift for each, and a summary."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.product import Parts
from tests.pipeline.toys.products import Info, Shift, Summary, Track

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    spacing: int = Field(0, description="shift between two sessions")


def join(settings: Settings, tracks: Parts[Track], infos: Parts[Info]) -> Iterator:
    for number, (place, _) in enumerate(tracks.items()):
        yield _shift(number * settings.spacing, place["session"])
    names = tuple(place["session"] for place, _ in tracks.items())
    yield Summary(sessions=names, total=int(sum(track.total.sum() for track in tracks)))


def _shift(value: int, session: str):
    from scanloom.schemas.product import Part

    return Part(Shift(value=np.array([value])), session)
