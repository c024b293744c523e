"""Truth that only a simulator has, apart from poses and points; for evaluation and tests, never read by the pipeline."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Stream, Table, attribute, column


class Lie(IntEnum):
    """Why a fix is off although the receiver calls it good."""

    NONE = 0
    MULTIPATH = 1
    RECOVERY = 2
    MOVED = 3


@dataclass(frozen=True)
class TrueFixes(Table):
    """One row per message of the GNSS receiver: where its antenna was, and what was made of it."""

    NAME: ClassVar[str] = "true_fixes"

    stamp_ns: NDArray[np.int64] = column("i8", "stamp of the message, on the receiver's clock", unit="ns")
    true_ns: NDArray[np.int64] = column("i8", "true time of the measurement, on the LiDAR's clock", unit="ns")
    antenna_m: NDArray[np.float64] = column(
        "f8", "where the antenna was: east, north, up", unit="m", shape=(3,), frame="truth"
    )
    error_m: NDArray[np.float64] = column(
        "f8", "what the reported position is off by; NaN without fix", unit="m", shape=(3,), frame="truth"
    )
    lie: NDArray[np.uint8] = column("u1", "a value of Lie")


@dataclass(frozen=True)
class TrueObjects(Table):
    """One row per object that stands about: a box around it above the ground."""

    NAME: ClassVar[str] = "true_objects"

    instance: NDArray[np.uint16] = column("u2", "its number in `true_points`")
    what: NDArray[np.object_] = column("str", "`car` or `house`")
    x_m: NDArray[np.float64] = column("f8", "middle of its box, east", unit="m", frame="truth")
    y_m: NDArray[np.float64] = column("f8", "middle of its box, north", unit="m", frame="truth")
    z_m: NDArray[np.float64] = column("f8", "middle of its box, up", unit="m", frame="truth")
    yaw_rad: NDArray[np.float64] = column("f8", "direction of its length, from east", unit="rad")
    length_m: NDArray[np.float64] = column("f8", "size along its own x", unit="m")
    width_m: NDArray[np.float64] = column("f8", "size along its own y", unit="m")
    height_m: NDArray[np.float64] = column("f8", "size upwards from the ground", unit="m")


@dataclass(frozen=True)
class TrueTracks(Table):
    """One row per scan and object that moves at some time of the drive: its box in the middle of the sweep.

    An object that comes to rest for good is listed on, with a `class_` of its own from then on.
    """

    NAME: ClassVar[str] = "true_tracks"

    scan_index: NDArray[np.int64] = column("i8", "number of the scan in its session, from 0")
    instance: NDArray[np.uint16] = column("u2", "its number in `true_points`")
    what: NDArray[np.object_] = column("str", "`car`, `truck`, `bus`, `cyclist`, `person`, `dog` or `pram`")
    class_: NDArray[np.uint8] = column(
        "u1", "a value of PointClass: DYNAMIC, or STATIC once it stands for good"
    )
    points: NDArray[np.uint32] = column("u4", "returns of the scan that are from it")
    x_m: NDArray[np.float64] = column("f8", "middle of its box, east", unit="m", frame="truth")
    y_m: NDArray[np.float64] = column("f8", "middle of its box, north", unit="m", frame="truth")
    z_m: NDArray[np.float64] = column("f8", "middle of its box, up", unit="m", frame="truth")
    yaw_rad: NDArray[np.float64] = column("f8", "direction of its length, forward, from east", unit="rad")
    length_m: NDArray[np.float64] = column("f8", "size along its own x", unit="m")
    width_m: NDArray[np.float64] = column("f8", "size along its own y", unit="m")
    height_m: NDArray[np.float64] = column("f8", "size upwards from the ground", unit="m")
    speed_m_s: NDArray[np.float64] = column("f8", "speed over ground", unit="m/s")


@dataclass(frozen=True)
class TruePaint(Table):
    """What colour every point of one simulated scan has, in the order of the message."""

    NAME: ClassVar[str] = "true_paint"

    albedo: NDArray[np.uint8] = column(
        "u1", "red, green, blue (sRGB): what an image shows of it in white light of strength 1", shape=(3,)
    )
    lit: NDArray[np.uint8] = column(
        "u1", "1 where the sun shines on it, 0 in shadow; moving things cast none"
    )
    scan_index: int = attribute("number of the scan in its session, from 0")


class TrueColours(Stream[TruePaint]):
    """The colours of a simulated session's points; only with cameras."""

    NAME = "true_colours"
    ITEM = TruePaint
