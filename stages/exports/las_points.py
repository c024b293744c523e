"""Points as records of LAS 1.4, point format 6 with extra bytes, or 7 where cameras saw the map; LAZ and COPC share them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import RemovedTile
from scanloom.stages.exports.clouds import Cloud, columns_of_file, part_file, part_names, round_offset_m
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource

F8 = NDArray[np.float64]
Rows = NDArray[np.void]

SCALE_M = 0.001
RECORD = np.dtype(
    [
        ("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bit_fields", "u1"), ("classification_flags", "u1"),
        ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2"), ("point_source_id", "<u2"),
        ("gps_time", "<f8"), ("count", "<u4"), ("level", "u1"), ("normal_x", "i1"), ("normal_y", "i1"), ("normal_z", "i1"),
    ]
)  # fmt: skip
"""`point_source_id` is the number of the session, from 1."""
_COLOUR: Any = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
COLOURED = np.dtype([*RECORD.descr[:11], *_COLOUR, *RECORD.descr[11:]])
"""The same as point format 7; black where no camera saw a point."""
_COLOUR_STEPS = 257
"""From 8 bits to 16, as the standard asks for."""
NORMAL_STEPS = 127.0
EXTRA_BYTES: tuple[tuple[str, str, str, float | None], ...] = (
    ("count", "u4", "measured points averaged", None),
    ("level", "u1", "level of detail, 0 is finest", None),
    ("normal_x", "i1", "surface normal along x", 1.0 / NORMAL_STEPS),
    ("normal_y", "i1", "surface normal along y", 1.0 / NORMAL_STEPS),
    ("normal_z", "i1", "surface normal, up", 1.0 / NORMAL_STEPS),
)
"""Name, type, description of at most 31 characters, scale."""

_ONE_RETURN_OF_ONE = 0x11
_WITHHELD = 1 << 2
CLASSES = np.zeros(256, np.uint8)
"""ASPRS code of each of our classes. Static is everything that stands: unclassified, since nobody looked whether it is a
building. Dust, rain and snow hang in the air: high noise. 64 and up are free for users by the standard."""
for _ours, _asprs in {
    PointClass.GROUND: 2,
    PointClass.STATIC: 1,
    PointClass.DYNAMIC: 64,
    PointClass.AIRBORNE: 18,
    PointClass.EGO: 66,
    PointClass.OUTLIER: 7,
    PointClass.OUT_OF_RANGE: 7,
    PointClass.CHANGED: 65,
}.items():
    CLASSES[_ours] = _asprs

NS_PER_S = 1_000_000_000
GPS_EPOCH_S = 315_964_800
"""1980-01-06 in seconds since 1970, UTC."""
ADJUSTED_BY_S = 1_000_000_000
"""LAS subtracts as much from GPS time for the sake of precision."""
LEAP_SECONDS_S = np.array(
    [
        362793600, 394329600, 425865600, 489024000, 567993600, 631152000, 662688000, 709948800, 741484800, 773020800,
        820454400, 867715200, 915148800, 1136073600, 1230768000, 1341100800, 1435708800, 1483228800,
    ],
    np.int64,
)  # fmt: skip
"""When GPS time gained another second on UTC, in seconds since 1970 (IERS Bulletin C; none was announced after 2017)."""


@dataclass(frozen=True)
class Records:
    """Makes records of clouds, all of one map alike."""

    offset_m: F8
    """(3,)"""
    intensity_scale: float
    unix_time: bool
    """Whether stamps are seconds since 1970; else `gps_time` is the log's own clock, s."""
    coloured: bool
    """Whether any point has a colour."""
    last_day: date
    """Of the last stamp; files are dated so, since two exports of one map shall be the same bytes."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of a record."""
        return COLOURED if self.coloured else RECORD

    @property
    def point_format(self) -> int:
        return 7 if self.coloured else 6

    @property
    def extra_bytes(self) -> int:
        """Of a record, behind what its format has."""
        return self.dtype.itemsize - (36 if self.coloured else 30)

    @classmethod
    def of(cls, source: MapSource, projector: Projector, options: Options) -> Records:
        """Offset, scale of intensities and kind of time, from the whole map."""
        strongest, first_ns, last_ns = _survey(source, part_names(source, options))
        return cls(
            offset_m=round_offset_m(source, projector),
            intensity_scale=intensity_scale(strongest),
            unix_time=first_ns >= GPS_EPOCH_S * NS_PER_S,
            coloured=source.coloured,
            last_day=datetime.fromtimestamp(last_ns // NS_PER_S, UTC).date(),
        )

    def __call__(self, cloud: Cloud) -> Rows:
        """Packed rows (n,) of `dtype`."""
        tile = cloud.tile
        out = np.zeros(len(cloud), self.dtype)
        for axis, name in enumerate("XYZ"):
            out[name] = np.rint((cloud.xyz[:, axis] - self.offset_m[axis]) / SCALE_M)
        out["intensity"] = np.clip(np.rint(tile.intensity * np.float64(self.intensity_scale)), 0, 65535)
        out["bit_fields"] = _ONE_RETURN_OF_ONE
        out["classification_flags"] = _WITHHELD if isinstance(tile, RemovedTile) else 0
        out["classification"] = CLASSES[tile.class_]
        out["point_source_id"] = tile.session + 1
        out["gps_time"] = gps_time(tile.first_ns) if self.unix_time else tile.first_ns / NS_PER_S
        out["count"], out["level"] = tile.count, tile.level
        if self.coloured:
            for axis, name in enumerate(("red", "green", "blue")):
                out[name] = tile.colour[:, axis] * np.uint16(_COLOUR_STEPS)
        steps = np.rint(cloud.normals * NORMAL_STEPS)
        for axis, name in enumerate("xyz"):
            out[f"normal_{name}"] = steps[:, axis]
        return out


def intensity_scale(strongest: float) -> float:
    """LAS wants 16 bits, whatever a sensor's own range: 0 to 1, 0 to 255 or 0 to 65535 fill them; more is cut down."""
    for limit in (1.0, 255.0, 65535.0):
        if strongest <= limit:
            return 65535.0 / limit
    return 65535.0 / strongest


def gps_time(stamp_ns: NDArray[np.int64]) -> F8:
    """Adjusted standard GPS time, s (LAS 1.4 R15, 2.6): GPS seconds less 10^9. Stamps are UTC since 1970, ns.

    GPS time does not stop for leap seconds: since 2017 it is 18 s ahead of UTC.
    """
    leaps = np.searchsorted(LEAP_SECONDS_S * NS_PER_S, stamp_ns, side="right")
    shift_ns = (GPS_EPOCH_S + ADJUSTED_BY_S) * NS_PER_S
    # Whole numbers first: a double has steps of 0.2 microseconds at today's seconds since 1970.
    return np.asarray((stamp_ns - shift_ns + leaps * NS_PER_S) / NS_PER_S, np.float64)


def places_of(rows: Rows) -> NDArray[np.int64]:
    """(n, 3) in steps of `SCALE_M` from the offset."""
    return np.column_stack((rows["X"], rows["Y"], rows["Z"])).astype(np.int64)


def las_header(projector: Projector, records: Records) -> Any:
    """Header of laspy: version, scale, offset, coordinate system, kind of time, extra bytes."""
    import laspy
    from laspy.header import GpsTimeType
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(version="1.4", point_format=records.point_format)
    header.scales, header.offsets = np.full(3, SCALE_M), records.offset_m
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                name,
                np.dtype(kind),
                text,
                offsets=None if scale is None else np.zeros(1),
                scales=None if scale is None else np.array([scale]),
            )
            for name, kind, text, scale in EXTRA_BYTES
        ]
    )
    # Point formats 6 to 10 say that a coordinate system, if there is one, is WKT.
    header.global_encoding.wkt = True
    if projector.wkt:
        header.vlrs.append(WktCoordinateSystemVlr(projector.wkt))
    if records.unix_time:
        header.global_encoding.gps_time_type = GpsTimeType.STANDARD
    header.system_identifier, header.generating_software = "Scanloom", "Scanloom"
    header.creation_date = records.last_day
    return header


def _survey(source: MapSource, names: Iterable[str]) -> tuple[float, int, int]:
    """Highest intensity, earliest and latest stamp of all points, from two columns of each file."""
    strongest, first, last = 0.0, [], []
    for name in names:
        table = columns_of_file(part_file(source, name), ["intensity", "first_ns"])
        if table.num_rows:
            strongest = max(strongest, float(np.nanmax(table["intensity"].to_numpy(), initial=0.0)))
            stamps = table["first_ns"].to_numpy()
            first.append(int(stamps.min()))
            last.append(int(stamps.max()))
    return strongest, min(first, default=0), max(last, default=0)
