"""Objects that move: boxes over time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Table, column


class ObjectClass(IntEnum):
    """What a tracked object is, by its size and how it moves; written in `tracks.class_`."""

    UNKNOWN = 0
    VEHICLE = 1
    TRUCK = 2
    CYCLIST = 3
    PERSON = 4


@dataclass(frozen=True)
class ObjectTracks(Table):
    """One row per scan and track of an object that moves at some time of the session: its box around what was seen of it.

    Things that never move have no rows. An object's origin is the middle of the foot of its box, x forward, z up.
    """

    NAME: ClassVar[str] = "tracks"

    scan_index: NDArray[np.int64] = column("i8", "number of the scan in its session, from 0")
    stamp_ns: NDArray[np.int64] = column("i8", "reference time of the scan", unit="ns")
    track: NDArray[np.int32] = column(
        "i4", "number of the track, from 0; an object lost and found has several"
    )
    T_odom_object: NDArray[np.float64] = column(
        "f8", "pose of the object", unit="m", shape=(4, 4), frame="odom"
    )
    T_lidar_object: NDArray[np.float64] = column(
        "f8", "the same in the scan it was seen in", unit="m", shape=(4, 4), frame="lidar"
    )
    length_m: NDArray[np.float64] = column("f8", "size along its own x", unit="m")
    width_m: NDArray[np.float64] = column("f8", "size along its own y", unit="m")
    height_m: NDArray[np.float64] = column("f8", "size upwards from the ground", unit="m")
    speed_m_s: NDArray[np.float64] = column("f8", "speed over ground", unit="m/s")
    class_: NDArray[np.uint8] = column("u1", "a value of ObjectClass; the same for the whole track")
    dynamic: NDArray[np.bool_] = column(
        "?", "its points belong to something that moves; false once it stands to the end of its track"
    )
    score: NDArray[np.float64] = column(
        "f8",
        "share of the places it left, or came to, that were seen to be empty, 0 to 1; the same for the whole track",
    )

    def boxes(self) -> NDArray[np.float64]:
        """(n, 15) per row the upper three rows of T_lidar_object, then length, width, height: as `inside_boxes` reads."""
        pose = self.T_lidar_object[:, :3].reshape(-1, 12)
        return np.ascontiguousarray(np.column_stack((pose, self.length_m, self.width_m, self.height_m)))
