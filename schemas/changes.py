"""What has changed since: places of an extended map that a new session saw through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Files, Table, attribute, column


@dataclass(frozen=True)
class Changes(Table):
    """One row per point of the old map that is no longer there. Cleaning has taken most of them out of the map."""

    NAME: ClassVar[str] = "changes"

    x_m: NDArray[np.float64] = column("f8", "place", unit="m", frame="world or map")
    y_m: NDArray[np.float64] = column("f8", "place", unit="m", frame="world or map")
    z_m: NDArray[np.float64] = column("f8", "place", unit="m", frame="world or map")
    through: NDArray[np.int32] = column("i4", "scans of the new sessions that saw through it")
    confirming: NDArray[np.int32] = column("i4", "scans of the new sessions with a return on it")
    object_: NDArray[np.int32] = column("i4", "number of the object it belongs to, from 0, largest first")
    remnants: int = attribute(
        "points missed, too, that the old sessions had seen through themselves: what moving things left in the map"
    )
    sessions: tuple[str, ...] = attribute("the new sessions")
    frame: str = attribute("`world` or `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")


@dataclass(frozen=True)
class ChangeFiles(Files):
    """The same points as a cloud: `changes.ply`. Empty for a map that extends none."""

    NAME: ClassVar[str] = "change_files"
