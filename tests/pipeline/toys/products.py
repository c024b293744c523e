"""Products of the toy workflow: a log of numbers, its chunks, their sums, and what is made of them all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Document, Files, Stream, Table, attribute, column


@dataclass(frozen=True)
class Log(Files):
    NAME: ClassVar[str] = "log"


@dataclass(frozen=True)
class Numbers(Table):
    NAME: ClassVar[str] = "numbers"
    value: NDArray[np.int64] = column("i8", "a number")
    index: int = attribute("number of the item")


class Chunk(Stream[Numbers]):
    NAME = "chunk_numbers"
    SPLIT_BY = "chunk"
    ITEM = Numbers


class Smooth(Stream[Numbers]):
    NAME = "smooth"
    ITEM = Numbers


class Info(Document):
    NAME: ClassVar[str] = "info"
    count: int
    title: str


@dataclass(frozen=True)
class Track(Table):
    NAME: ClassVar[str] = "track"
    total: NDArray[np.int64] = column("i8", "sum per item")


@dataclass(frozen=True)
class Shift(Table):
    NAME: ClassVar[str] = "shift"
    SPLIT_BY: ClassVar[str] = "session"
    value: NDArray[np.int64] = column("i8", "what to add in this session")


class Summary(Document):
    NAME: ClassVar[str] = "summary"
    sessions: tuple[str, ...]
    total: int


@dataclass(frozen=True)
class Piece(Table):
    NAME: ClassVar[str] = "piece"
    SPLIT_BY: ClassVar[str] = "tile"
    value: NDArray[np.int64] = column("i8", "numbers that fall into the tile")


@dataclass(frozen=True)
class Tile(Table):
    NAME: ClassVar[str] = "tile"
    SPLIT_BY: ClassVar[str] = "tile"
    value: NDArray[np.int64] = column("i8", "numbers of the tile, sorted")
    origins: tuple[str, ...] = attribute("session/chunk of each contribution")


@dataclass(frozen=True)
class TileText(Files):
    NAME: ClassVar[str] = "tile_text"
    SPLIT_BY: ClassVar[str] = "tile"


class Overview(Document):
    NAME: ClassVar[str] = "overview"
    tiles: tuple[str, ...]
    count: int
