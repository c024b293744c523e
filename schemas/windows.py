"""Windows of a long session: stretches that overlap, tracked side by side, and what it takes to join their tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Document, Table, attribute, column
from scanloom.schemas.trajectory import Odometry


class Window(Document):
    """Scans `first` to `last` - 1 of a session; those before `own` are the window's before it, too. One part per window."""

    NAME: ClassVar[str] = "window"
    SPLIT_BY: ClassVar[str] = "window"

    first: int
    own: int
    last: int
    chunk: int = 0
    """Number of the chunk that holds scan `first`, from 0."""
    chunk_first: int = 0
    """First scan of that chunk."""

    @property
    def overlap(self) -> int:
        """Number of scans that the window before has, too."""
        return self.own - self.first


@dataclass(frozen=True)
class Track(Odometry):
    """Odometry of one window; frame `odom` starts at the window's first scan."""

    NAME: ClassVar[str] = "track"

    overlap: int = attribute("number of first scans that the window before has, too")


@dataclass(frozen=True)
class TrackEnds(Table):
    """What a window saw at its ends, by which it is laid onto its neighbours.

    At the end: what the local map kept, in the frame of the last scan. At the begin: some scans of the overlap,
    thinned, in the frame of the overlap's last scan.
    """

    NAME: ClassVar[str] = "track_ends"
    ON_THE_WAY: ClassVar[bool] = True

    x_m: NDArray[np.float32] = column("f4", "forward", unit="m", frame="lidar")
    y_m: NDArray[np.float32] = column("f4", "left", unit="m", frame="lidar")
    z_m: NDArray[np.float32] = column("f4", "up", unit="m", frame="lidar")
    at_end: NDArray[np.bool_] = column(
        "?", "point of the local map at the end; else of the overlap at the begin"
    )
    voxel_size_m: float = attribute("edge of a voxel of the local map, m")

    def points(self, *, at_end: bool) -> NDArray[np.float64]:
        """(n, 3) coordinates of one end, m."""
        rows = self.at_end == at_end
        return np.column_stack((self.x_m[rows], self.y_m[rows], self.z_m[rows])).astype(np.float64)
