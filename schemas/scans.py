"""Point clouds inside the pipeline: raw scans, deskewed scans, labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Stream, Table, attribute, column


class PointClass(IntEnum):
    """What a point is; written in `labels.class`."""

    UNLABELLED = 0
    GROUND = 1
    STATIC = 2
    DYNAMIC = 3
    AIRBORNE = 4
    EGO = 5
    OUTLIER = 6
    OUT_OF_RANGE = 7
    CHANGED = 8
    """Stood while one session passed and was gone when a later one did."""


class Cloud:
    """Points with coordinates in columns of their own."""

    x_m: NDArray[np.float32]
    y_m: NDArray[np.float32]
    z_m: NDArray[np.float32]

    def points(self) -> NDArray[np.float32]:
        """(n, 3) coordinates in the LiDAR frame, metres."""
        return np.column_stack((self.x_m, self.y_m, self.z_m))


@dataclass(frozen=True)
class Scan(Cloud, Table):
    """One sweep of a LiDAR as measured; coordinates at each point's own time. Points without return are not kept."""

    NAME: ClassVar[str] = "scan"

    stamp_ns: NDArray[np.int64] = column("i8", "time the point was measured, on the LiDAR's clock", unit="ns")
    x_m: NDArray[np.float32] = column("f4", "forward", unit="m", frame="lidar")
    y_m: NDArray[np.float32] = column("f4", "left", unit="m", frame="lidar")
    z_m: NDArray[np.float32] = column("f4", "up", unit="m", frame="lidar")
    intensity: NDArray[np.float32] = column("f4", "strength of the return as the sensor reports it")
    ring: NDArray[np.uint16] = column("u2", "beam, 0 is the lowest; 0 throughout when unknown")
    return_no: NDArray[np.uint8] = column("u1", "0 for the first return of a pulse, 1 for the second")
    reference_ns: int = attribute("reference time of the scan: the middle of its sweep, ns")
    scan_index: int = attribute("number of the scan in its session, from 0")


@dataclass(frozen=True)
class DeskewedScan(Cloud, Table):
    """One sweep with all points expressed in the LiDAR frame at `reference_ns`.

    Same points in the same order as the scan, which keeps what else was measured of them: every later stage reads this.
    """

    NAME: ClassVar[str] = "deskewed_scan"
    SCHEMA_VERSION: ClassVar[int] = 2

    x_m: NDArray[np.float32] = column("f4", "forward", unit="m", frame="lidar")
    y_m: NDArray[np.float32] = column("f4", "left", unit="m", frame="lidar")
    z_m: NDArray[np.float32] = column("f4", "up", unit="m", frame="lidar")
    intensity: NDArray[np.float32] = column("f4", "strength of the return as the sensor reports it")
    reference_ns: int = attribute("time at which the LiDAR's frame is meant: the middle of the sweep, ns")
    scan_index: int = attribute("number of the scan in its session, from 0")
    next_twist: Sequence[float] = attribute(
        "motion to the next scan of the chunk where it was found by registration, else empty: six numbers, turn (rad/s) "
        "and speed (m/s) of the LiDAR in its own frame",
        default=(),
    )


class Scans(Stream[Scan]):
    """The scans of one chunk of a session (about 20 s, fewer when the scans are large)."""

    NAME = "scans"
    SPLIT_BY = "chunk"
    ITEM = Scan


class Deskewed(Stream[DeskewedScan]):
    """The deskewed scans of one chunk."""

    NAME = "deskewed"
    SCHEMA_VERSION = 2
    ITEM = DeskewedScan


@dataclass(frozen=True)
class ScanLabels(Table):
    """Class of every point of one deskewed scan, in the same order."""

    NAME: ClassVar[str] = "scan_labels"

    class_: NDArray[np.uint8] = column("u1", "a value of PointClass")
    reference_ns: int = attribute("reference time of the scan, ns")
    scan_index: int = attribute("number of the scan in its session, from 0")


class Labels(Stream[ScanLabels]):
    """The labels of one chunk."""

    NAME = "labels"
    ITEM = ScanLabels


@dataclass(frozen=True)
class TrueLabels(Table):
    """What every point of one simulated scan truly is, in the order of the message; for evaluation and tests only."""

    NAME: ClassVar[str] = "true_labels"
    SCHEMA_VERSION: ClassVar[int] = 2

    class_: NDArray[np.uint8] = column("u1", "a value of PointClass")
    instance: NDArray[np.uint16] = column("u2", "number of the object, 0 for none")
    material: NDArray[np.uint8] = column(
        "u1", "what it is made of, a value of the simulator's Material: leaves, bark and grass are vegetation"
    )
    scan_index: int = attribute("number of the scan in its session, from 0")


class TruePoints(Stream[TrueLabels]):
    """The true labels of a simulated session."""

    NAME = "true_points"
    SCHEMA_VERSION = 2
    ITEM = TrueLabels
