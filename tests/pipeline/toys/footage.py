"""Images of a log of numbers: one frame per even number, tints of what they show by tile; and tiles made of both."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from scanloom.pipeline.node import Node, node
from scanloom.schemas.product import Document, Part, Parts, Stream, Table, column
from tests.pipeline.toys.products import Log, Numbers, Piece, Tile
from tests.pipeline.toys.workflow import NODES

VERSION = 1


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Frames(Stream[Numbers]):
    NAME = "frames"
    SPLIT_BY = "footage"
    ITEM = Numbers


class Lenses(Document):
    NAME: ClassVar[str] = "lenses"
    count: int


@dataclass(frozen=True)
class Tint(Table):
    NAME: ClassVar[str] = "tint"
    SPLIT_BY: ClassVar[str] = "tile"
    value: NDArray[np.int64] = column("i8", "numbers seen")


class Gallery(Document):
    NAME: ClassVar[str] = "gallery"
    tints: dict[str, int]
    frames: int


def show(settings: Settings, log: Log) -> Iterator[Part[Frames] | Lenses]:
    """Two parts for a log with even numbers, else none."""
    even = [int(v) for v in log.read("log.txt").decode().split() if v.isdigit() and not int(v) % 2]
    for n, half in enumerate((even[: len(even) // 2], even[len(even) // 2 :])):
        if half:
            yield Part(Frames([Numbers(value=np.array(half), index=n)]), f"{n:04d}")
    yield Lenses(count=bool(even))


def tint(settings: Settings, frames: Frames, lenses: Lenses, pieces: Parts[Piece]) -> Iterator[Part[Tint]]:
    known = {place["tile"] for place in pieces.coordinates()}
    values = np.concatenate([frame.value for frame in frames])
    for tile in sorted(known & {f"{v // 10}_0" for v in values.tolist()}):
        yield Part(Tint(value=values[values // 10 == int(tile.split("_")[0])]), tile)


def hang(settings: Settings, tiles: Parts[Tile], tints: Parts[Tint], frames: Parts[Frames]) -> Gallery:
    sizes = {place["tile"]: 0 for place, _ in tiles.items()}
    for place, seen in tints.items():
        sizes[place["tile"]] += len(seen)
    return Gallery(tints=sizes, frames=sum(len(part) for part in frames))


def mix(settings: Settings, pieces: Parts[Piece], tints: Parts[Tint]) -> Tile:
    values = np.concatenate([part.value for part in (*pieces, *tints)])
    return Tile(value=values, origins=tuple(place["footage"] for place in tints.coordinates()))


WITH_FOOTAGE: tuple[Node, ...] = (
    *(n for n in NODES if n.name != "paint"),
    node("show", show, per="session", reads=(Log,), writes=(Frames, Lenses)),
    node("tint", tint, per="footage", reads=(Frames, Lenses, Piece), writes=Tint),
    node("paint", mix, per="tile", reads=(Piece, Tint), writes=Tile),
    node("hang", hang, per="map", reads=(Tile, Tint, Frames), writes=Gallery),
)
