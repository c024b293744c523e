"""A delivered map, opened for reading: what every export starts from."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import pyarrow.parquet as pq

from scanloom.schemas.errors import InvalidInput, ProductError
from scanloom.schemas.frames import Georeference
from scanloom.schemas.product import Table
from scanloom.schemas.tiles import Tile, TileIndex
from scanloom.schemas.trajectory import Poses

HEADER, INDEX = "map.json", "tiles/index.parquet"


T = TypeVar("T", bound=Table)


def opened(kind: type[T], path: Path) -> T:
    """A table of a delivered map.

    Raises
    ------
    InvalidInput : it is missing or damaged, so that the map is not whole.
    """
    try:
        return kind.open(path)
    except ProductError as error:
        raise InvalidInput(
            f"is part of the map and {error.what}",
            where=str(path),
            next_step="make the map whole by the `scanloom map` command that made it: what the store holds is not computed again",
        ) from error


def any_coloured(path: Path) -> bool:
    """Whether a file of tiles has a point that a camera saw, from its footer alone; one that is not there says so when
    it is read."""
    try:
        metadata = pq.read_metadata(path)
    except (OSError, ValueError):
        return False
    columns = {metadata.schema.column(i).path: i for i in range(metadata.num_columns)}
    if "views" not in columns:
        return False
    kept = (metadata.row_group(n).column(columns["views"]).statistics for n in range(metadata.num_row_groups))
    return any(each is not None and each.has_min_max and each.max > 0 for each in kept)


@dataclass(frozen=True)
class MapSource:
    """The folder of a map. Tiles are read one by one, whenever they are asked for."""

    folder: Path
    header: dict[str, Any]
    """Content of `map.json`."""
    index: TileIndex
    passed: Callable[[], None] = field(default=lambda: None, compare=False)
    """Called whenever a writer goes on to another tile, so that somebody can say how far it is."""

    @classmethod
    def open(cls, folder: Path) -> MapSource:
        """
        Raises
        ------
        InvalidInput : the folder holds no map, or a damaged one.
        """
        try:
            header = json.loads((folder / HEADER).read_text())
            if not isinstance(header, dict) or "name" not in header:
                raise ValueError("it describes no map")
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else str(error)
            raise InvalidInput(
                f"holds no map: {HEADER} cannot be read ({why})",
                where=str(folder),
                next_step="give the folder that `scanloom map` wrote, for instance maps/sample",
            ) from error
        return cls(folder, header, opened(TileIndex, folder / INDEX))

    @property
    def name(self) -> str:
        return str(self.header["name"])

    @property
    def georeference(self) -> Georeference | None:
        """Where the map's frame stands on the Earth; None for a map without GNSS."""
        fields = self.index.georeference
        return None if fields is None else Georeference(**fields)

    @property
    def tile_names(self) -> list[str]:
        """In the order of the index."""
        return self.index.names

    def tile(self, name: str) -> Tile:
        """Points of one tile."""
        return opened(Tile, self.folder / "tiles" / f"{name}.parquet")

    def tiles(self) -> Iterator[tuple[str, Tile]]:
        """Tile after tile, by name."""
        for name in self.tile_names:
            yield name, self.tile(name)
            self.passed()

    @cached_property
    def coloured(self) -> bool:
        """Whether cameras saw any point of the map."""
        return any(any_coloured(self.folder / "tiles" / f"{name}.parquet") for name in self.tile_names)

    @property
    def points(self) -> int:
        return int(self.index.points.sum())

    def trajectories(self) -> dict[str, Poses]:
        """Poses of each session, by its name."""
        single = self.folder / "trajectory.parquet"
        if single.exists():
            return {str(self.header["sessions"][0]["name"]): Poses.open(single)}
        return {
            path.stem: Poses.open(path) for path in sorted((self.folder / "trajectory").glob("*.parquet"))
        }
