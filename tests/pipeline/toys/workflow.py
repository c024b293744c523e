"""The toy workflow, with the same fan-out as the real one: session, chunk, session, map, chunk, tile, map."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scanloom.pipeline.node import Node, node
from scanloom.pipeline.plan import Request, SessionInput
from tests.pipeline.toys.cut import cut
from tests.pipeline.toys.join import join
from tests.pipeline.toys.make import make
from tests.pipeline.toys.paint import paint
from tests.pipeline.toys.products import (
    Chunk,
    Info,
    Log,
    Overview,
    Piece,
    Shift,
    Smooth,
    Summary,
    Tile,
    TileText,
    Track,
)
from tests.pipeline.toys.read import read
from tests.pipeline.toys.smooth import smooth
from tests.pipeline.toys.survey import survey
from tests.pipeline.toys.track import track

NODES: tuple[Node, ...] = (
    node("make", make, per="session", writes=Log, only="simulated"),
    node("read", read, per="session", reads=(Log,), writes=(Chunk, Info)),
    node("smooth", smooth, per="chunk", reads=(Chunk, Info), writes=Smooth),
    node("track", track, per="session", reads=(Smooth,), writes=Track),
    node("join", join, per="map", reads=(Track, Info), writes=(Shift, Summary)),
    node("cut", cut, per="chunk", reads=(Smooth, Shift), writes=Piece),
    node("paint", paint, per="tile", reads=(Piece,), writes=(Tile, TileText)),
    node("survey", survey, per="map", reads=(Tile,), writes=Overview),
)


def log(folder: Path, name: str, values: Any, word: str = "") -> SessionInput:
    """A session with a log of numbers, and perhaps a word that makes the reader fail."""
    (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / name / "log.txt").write_text(" ".join([*map(str, values), word]))
    return SessionInput(name, {Log: Log(root=folder / name, names=("log.txt",))})


def request(*sessions: SessionInput, settings: Mapping[str, Mapping[str, Any]] | None = None) -> Request:
    return Request(NODES, sessions, settings or {})
