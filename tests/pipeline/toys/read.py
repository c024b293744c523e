"""Reads a log of numbers into chunks. A word in the log stands for a fault: what it says happens."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.product import Part
from tests.pipeline.toys.products import Chunk, Info, Log, Numbers

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    chunk_items: int = Field(2, ge=1, le=100, description="items per chunk")
    item_rows: int = Field(5, ge=1, description="numbers per item")


def read(settings: Settings, log: Log) -> Iterator[Part | Info]:
    words = log.read(log.names[0]).decode().split()
    _obey(words, log.root)
    values = np.array(words, dtype=np.int64)
    rows, per_chunk = settings.item_rows, settings.chunk_items
    items = [Numbers(value=values[i : i + rows], index=i // rows) for i in range(0, len(values), rows)]
    for number, first in enumerate(range(0, len(items), per_chunk)):
        yield Part(Chunk(items[first : first + per_chunk]), f"{number:04d}")
    yield Info(count=len(values), title=log.names[0])


def _obey(words: list[str], root: Path | None) -> None:
    if "broken" in words:
        raise InvalidInput("the log is broken", where="log", next_step="bring another")
    if "odd" in words:
        raise KeyError("odd thing")
    if "deadly" in words and root is not None:
        with (root / "deaths").open("a") as deaths:
            deaths.write("x")
        os._exit(9)
    if "growing" in words and root is not None:
        (root / "log.txt").write_text(" ".join([*words, "1"]))
    if "once" in words and root is not None and not (root / "died").exists():
        (root / "died").touch()
        os._exit(9)
    while words and not words[-1].lstrip("-").isdigit():
        words.pop()
