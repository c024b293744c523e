"""What free space says of the map: rays per voxel, verdicts per voxel, final classes per point."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Stream, Table, attribute, column
from scanloom.schemas.scans import PointClass, ScanLabels

BRICK_SIDE = 8
BRICK_VOXELS = BRICK_SIDE**3
"""Voxels are kept in bricks of 8 x 8 x 8: a ray stays in one for a while, and empty space takes no room."""


class Standing(IntEnum):
    """What is known of a voxel that a session met something in."""

    UNKNOWN = 0
    STANDS = 1
    """Met again and again, hardly ever seen through."""
    MOVED = 2
    """Seen through by the session itself at other times: what was met there passed, or left."""
    CHANGED = 3
    """Stood while this session passed; a later one saw through it."""


@dataclass(frozen=True)
class Rays(Table):
    """What one chunk says of the voxels of one tile. One row per brick; one part per tile, keyed `X_Y`.

    Counts are of bins of some scans. A bin sees through a voxel when one of its rays passes well before its return and none
    of its returns lies in the voxel or next to it.
    """

    NAME: ClassVar[str] = "rays"
    ON_THE_WAY: ClassVar[bool] = True
    SPLIT_BY: ClassVar[str] = "tile"

    brick: NDArray[np.int64] = column(
        "i8", "key of the brick by its indices in the map, see `geometry.voxels.pack`"
    )
    hits: NDArray[np.uint8] = column(
        "u1", "bins with a return, not of the ground, in each voxel, x slowest", shape=(BRICK_VOXELS,)
    )
    tracked: NDArray[np.uint8] = column(
        "u1", "those of them with a return from what the tracker saw move", shape=(BRICK_VOXELS,)
    )
    before: NDArray[np.uint8] = column(
        "u1",
        "bins that saw through each voxel before its first hit, or at all without one",
        shape=(BRICK_VOXELS,),
    )
    between: NDArray[np.uint8] = column("u1", "the same between hits", shape=(BRICK_VOXELS,))
    after: NDArray[np.uint8] = column("u1", "the same after the last hit", shape=(BRICK_VOXELS,))
    first_ns: int = attribute("reference time of the chunk's first scan, ns")
    voxel_size_m: float = attribute("edge of a voxel, m")
    tile_size_m: float = attribute("edge of a tile, m")
    frame: str = attribute("`world` or `map`")


@dataclass(frozen=True)
class Cleared(Table):
    """Verdicts on the voxels of one tile for the points of one session. One row per brick; one part per session."""

    NAME: ClassVar[str] = "cleared"
    ON_THE_WAY: ClassVar[bool] = True
    SPLIT_BY: ClassVar[str] = "session"

    brick: NDArray[np.int64] = column("i8", "key of the brick by its indices in the map")
    verdict: NDArray[np.uint8] = column(
        "u1", "a value of Standing for each voxel, x slowest", shape=(BRICK_VOXELS,)
    )
    voxel_size_m: float = attribute("edge of a voxel, m")
    tile_size_m: float = attribute("edge of a tile, m")


class FinalLabels(Stream[ScanLabels]):
    """The classes of one chunk's points after all that the whole map says of them."""

    NAME = "final_labels"
    ITEM = ScanLabels


@dataclass(frozen=True)
class ClassCounts(Table):
    """How many points of each class a chunk has. One row per scan."""

    NAME: ClassVar[str] = "class_counts"

    scan_index: NDArray[np.int64] = column("i8", "number of the scan in its session")
    points: NDArray[np.int64] = column(
        "i8", "points of each PointClass, by its value", shape=(len(PointClass),)
    )
    before: NDArray[np.int64] = column(
        "i8", "the same as denoise had them, before the map was asked", shape=(len(PointClass),)
    )
