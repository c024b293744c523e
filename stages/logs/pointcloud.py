"""Clouds from messages: every usual PointCloud2 layout, Livox custom messages, and times of points that carry none.

Sources: sensor_msgs/PointCloud2 and PointField (ROS common_interfaces), the fields written by the drivers of Velodyne
(`time`), Ouster (`t`), Hesai and Robosense (`timestamp`), Livox (`offset_time`, `timestamp`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.geometry.sweep import detect_sweep, elevation_trend, reaches_around, sweep_times
from scanloom.stages.logs.records import Cloud, LivoxCloud, PointCloud2, PointField

DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8"}
"""sensor_msgs/PointField; 9 and 10 are not in the standard, some drivers use them."""

INTENSITY_NAMES = ("intensity", "intensities", "i", "reflectivity", "reflectance", "signal")
RING_NAMES = ("ring", "channel", "line", "laser_id", "laser", "ring_id", "beam")
TIME_NAMES = (
    "t",
    "time",
    "timestamp",
    "time_stamp",
    "offset_time",
    "time_offset",
    "timestamps",
    "point_time",
    "rel_time",
)
RETURN_NAMES = ("return_no", "return_number", "return_index", "echo")

SHORTEST_SWEEP_NS, LONGEST_SWEEP_NS = 4e6, 2e9
"""Spans of point times within one cloud that a sensor can have; they tell the unit of a time field."""
OWN_CLOCK_NS = 5_000_000_000
"""Points further from their header than this carry another clock."""
LONGEST_POINT = 2**31 - 1
"""Bytes of a point that numpy can stride over."""
BEAM_COUNTS = (4, 6, 8, 16, 32, 40, 64, 80, 128, 192, 256)


def decode_pointcloud2(message: PointCloud2) -> Cloud:
    """The columns of a PointCloud2.

    Bytes are viewed as a structured array; only the columns that are used are copied. Points without return stay in.

    Raises
    ------
    InvalidInput : sizes contradict each other, a datatype is unknown, or x, y, z are missing; it names the field.
    """
    table, remarks = _view(message)
    cloud = cloud_from_table(table, message.stamp_ns, height=message.height)
    remark = "; ".join(r for r in (*remarks, cloud.remark) if r)
    return replace(cloud, receive_ns=message.receive_ns, remark=remark)


def cloud_from_table(table: NDArray[Any], stamp_ns: int, *, height: int = 1) -> Cloud:
    """The columns of a structured array (n,) whose fields are named as drivers name them.

    Parameters
    ----------
    table : fields x, y, z and any of intensity, ring, time, return number, of any types.
    stamp_ns : stamp of the header, from which relative times count.
    height : rows of an organised cloud, stored one after the other; 1 otherwise.

    Raises
    ------
    InvalidInput : x, y or z is missing.
    """
    names = {name.lower(): name for name in table.dtype.names or ()}
    _need_xyz(names)
    x, y, z = (_column(table, names[axis], np.float32) for axis in "xyz")
    time_ns, time_remark = _point_times(table, names, stamp_ns, x, y, z)
    ring, ring_remark = _rings(table, names, height, x, y, z)
    return Cloud(
        stamp_ns=stamp_ns,
        receive_ns=stamp_ns,
        x_m=x,
        y_m=y,
        z_m=z,
        intensity=_first_column(table, names, INTENSITY_NAMES, np.float32),
        ring=ring,
        return_no=_returns(table, names),
        time_ns=time_ns,
        remark="; ".join(r for r in (time_remark, ring_remark) if r),
    )


def decode_livox(message: LivoxCloud) -> Cloud:
    """The columns of a Livox custom message. Bits 4 and 5 of `tag` number the return (Livox SDK, point tag)."""
    points = message.points
    base, remark = message.timebase_ns, ""
    if abs(base - message.stamp_ns) > OWN_CLOCK_NS:
        base, remark = (
            message.stamp_ns,
            "points count from a clock of their own; times taken from the header on",
        )
    return Cloud(
        stamp_ns=message.stamp_ns,
        receive_ns=message.receive_ns,
        x_m=points["x"].astype(np.float32),
        y_m=points["y"].astype(np.float32),
        z_m=points["z"].astype(np.float32),
        intensity=points["reflectivity"].astype(np.float32),
        ring=points["line"].astype(np.uint16),
        return_no=((points["tag"] >> 4) & 3).astype(np.uint8),
        time_ns=base + points["offset_time"].astype(np.int64),
        remark=remark,
    )


def azimuth_times(cloud: Cloud, period_ns: int) -> NDArray[np.int64]:
    """Time (n,) of each point since the start of its sweep, ns in [0, period_ns), from its azimuth.

    The turn is the cloud's own (`cloud.sweep`) where the format is known, else it is read from the order of the points.
    Where neither tells and the points do not reach around (a sensor that does not spin), all get the middle.
    """
    sweep = cloud.sweep or detect_sweep(cloud.x_m, cloud.y_m)
    if not sweep.detected and not reaches_around(cloud.x_m, cloud.y_m):
        return np.full(len(cloud.x_m), period_ns // 2, np.int64)
    return sweep_times(cloud.x_m, cloud.y_m, period_ns, sweep)


def correct_vertical_angle(cloud: Cloud, angle_rad: float) -> Cloud:
    """The cloud with every beam raised by `angle_rad` at unchanged range and azimuth.

    KITTI's HDL-64E scans are said to be calibrated 0.205 degrees too low (Deschaud, IMLS-SLAM, ICRA 2018).
    """
    flat = np.hypot(cloud.x_m, cloud.y_m)
    c, s = np.float32(np.cos(angle_rad)), np.float32(np.sin(angle_rad))
    with np.errstate(invalid="ignore", divide="ignore"):
        shrink = np.where(flat > 0, (c * flat - s * cloud.z_m) / flat, np.float32(1.0)).astype(np.float32)
    return replace(cloud, x_m=cloud.x_m * shrink, y_m=cloud.y_m * shrink, z_m=s * flat + c * cloud.z_m)


# ---------------------------------------------------------------------------------------------------------------------


def _view(message: PointCloud2) -> tuple[NDArray[Any], list[str]]:
    """The message's bytes as a structured array (n,), a view where rows follow each other without padding."""
    remarks = []
    height, width, step, row = message.height, message.width, message.point_step, message.row_step
    if step > LONGEST_POINT:
        raise InvalidInput(f"point_step is {step} bytes, more than any point has")
    dtype = _dtype(message.fields, step, message.is_bigendian)
    used = width * step
    if height > 1 and row < used:
        raise InvalidInput(f"row_step is {row} bytes, but {width} points of {step} bytes need {used}")
    if height == 1 and row != used:
        remarks.append(f"row_step is {row}, but one row has {used} bytes; taken as one row")
        row = used
    data = np.frombuffer(message.data, np.uint8)
    needed = row * (height - 1) + used if height and width else 0
    if len(data) < needed:
        raise InvalidInput(
            f"data has {len(data)} bytes, but {height} rows of {row} bytes (height, row_step) need {needed}"
        )
    table = np.ndarray((height, width), dtype, data.data if len(data) else b"", strides=(row, step))
    return table.reshape(-1), remarks


def _dtype(fields: tuple[PointField, ...], step: int, big: bool) -> np.dtype[Any]:
    order = ">" if big else "<"
    names, formats, offsets = [], [], []
    for field in fields:
        if field.datatype not in DATATYPES:
            raise InvalidInput(f"field {field.name} has unknown datatype {field.datatype}")
        kind = np.dtype(order + DATATYPES[field.datatype])
        if field.offset < 0 or field.offset + kind.itemsize > step:
            raise InvalidInput(
                f"field {field.name} ends at byte {field.offset + kind.itemsize}, past point_step {step}"
            )
        if field.name and field.name not in names:
            names.append(field.name)
            formats.append(kind)
            offsets.append(field.offset)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def _need_xyz(names: dict[str, str]) -> None:
    for axis in "xyz":
        if axis not in names:
            raise InvalidInput(
                f"field {axis} is missing; the cloud has {', '.join(names.values()) or 'no fields'}",
                next_step="choose another topic: this one holds no 3D points",
            )


def _column(table: NDArray[Any], name: str, dtype: Any) -> NDArray[Any]:
    # A NaN as ring or a number past float32 is the log's affair, not a reason to warn.
    with np.errstate(invalid="ignore", over="ignore"):
        return np.ascontiguousarray(table[name], dtype)


def _first_column(
    table: NDArray[Any], names: dict[str, str], wanted: tuple[str, ...], dtype: Any
) -> NDArray[Any]:
    for name in wanted:
        if name in names:
            return _column(table, names[name], dtype)
    return np.zeros(len(table), dtype)


def _returns(table: NDArray[Any], names: dict[str, str]) -> NDArray[np.uint8]:
    numbers = _first_column(table, names, RETURN_NAMES, np.uint8)
    counted_from_one = len(numbers) > 0 and numbers.min() == 1
    return numbers - np.uint8(1) if counted_from_one else numbers


def _rings(
    table: NDArray[Any], names: dict[str, str], height: int, *xyz: NDArray[np.float32]
) -> tuple[NDArray[np.uint16], str]:
    """Beam numbers with 0 the lowest, from the ring field or from the rows of an organised cloud."""
    name = next((name for name in RING_NAMES if name in names), "")
    if name:
        ring = _column(table, names[name], np.uint16)
    elif 4 <= height <= 256 and len(table) >= 4 * height:
        ring = np.repeat(np.arange(height, dtype=np.uint16), len(table) // height)
    else:
        return np.zeros(len(table), np.uint16), ""
    sample = slice(None, None, max(1, len(table) // 2000))
    x, y, z = (axis[sample] for axis in xyz)
    trend = elevation_trend(x, y, z, ring[sample].astype(np.int64))
    if not name and abs(trend) < 0.8:
        return np.zeros(len(table), np.uint16), ""
    if trend > -0.8:
        return ring, ""
    top = int(ring.max())
    if int(ring.min()) == 1 and top in BEAM_COUNTS:
        ring, top = ring - np.uint16(1), top - 1
    beams = next((count for count in BEAM_COUNTS if count > top), top + 1)
    return np.uint16(beams - 1) - ring, "beams are numbered from above; turned so that 0 is the lowest"


# --- time ------------------------------------------------------------------------------------------------------------


class _Unit(NamedTuple):
    name: str
    ns: float


UNITS = (
    _Unit("seconds", 1e9),
    _Unit("milliseconds", 1e6),
    _Unit("microseconds", 1e3),
    _Unit("nanoseconds", 1.0),
)


def _point_times(
    table: NDArray[Any], names: dict[str, str], stamp_ns: int, *xyz: NDArray[np.float32]
) -> tuple[NDArray[np.int64] | None, str]:
    """Absolute time of each point, ns, and what had to be guessed; None without a usable time field."""
    name = next((name for name in TIME_NAMES if name in names), "")
    if not name or len(table) == 0:
        return None, ""
    raw = np.ascontiguousarray(table[names[name]]).astype(
        table.dtype[names[name]].newbyteorder("="), copy=False
    )
    low, high = _range(raw, *xyz)
    if not (np.isfinite(low) and np.isfinite(high)) or (high == low and len(raw) > 64):
        return None, f"field {name} is the same for all points; times taken from azimuth"
    unit, guessed = _unit(raw.dtype, float(low), float(high))
    if unit is None:
        return (
            None,
            f"field {name} spans {float(high) - float(low):g}, no duration of a sweep; times taken from azimuth",
        )
    ns = _to_ns(raw, unit)
    first = int(_to_ns(np.array([low], raw.dtype), unit)[0])
    remark = f"field {name} taken as {unit.name}" if guessed else ""
    if abs(first) < OWN_CLOCK_NS:
        return stamp_ns + ns, remark
    if abs(first - stamp_ns) < OWN_CLOCK_NS:
        return ns, remark
    own = f"field {name} is on another clock than the header ({(first - stamp_ns) * 1e-9:+.3f} s); first point set to the header"
    return ns - first + stamp_ns, "; ".join(r for r in (remark, own) if r)


def _range(
    raw: NDArray[Any], x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]
) -> tuple[Any, Any]:
    """Lowest and highest time; points without return, whose time may be blank, count only when there are no others."""
    low, high = raw.min(), raw.max()
    if low == 0 or not (np.isfinite(low) and np.isfinite(high)):
        hit = np.isfinite(raw) & np.isfinite(x) & ((x != 0) | (y != 0) | (z != 0))
        if hit.any():
            return raw[hit].min(), raw[hit].max()
    return low, high


def _unit(dtype: np.dtype[Any], low: float, high: float) -> tuple[_Unit | None, bool]:
    """The unit in which the span of the values is a sweep, and whether it is not what the type suggests.

    Drivers write floats in seconds and integers in nanoseconds (Livox doubles too); that is kept for spans too short to
    tell. At most one unit fits, for the longest sweep is less than a thousand times the shortest.
    """
    usual = UNITS[0] if dtype.kind == "f" and abs(high) < 1e15 else UNITS[3]
    span = high - low
    for unit in UNITS:
        if SHORTEST_SWEEP_NS <= span * unit.ns <= LONGEST_SWEEP_NS:
            return unit, unit is not usual
    return (usual, False) if span * usual.ns < SHORTEST_SWEEP_NS else (None, True)


def _to_ns(raw: NDArray[Any], unit: _Unit) -> NDArray[np.int64]:
    """Whole nanoseconds; seconds since 1970 are split first, because doubles cannot hold their nanoseconds."""
    if raw.dtype.kind != "f":
        return raw.astype(np.int64) * np.int64(unit.ns)
    with np.errstate(invalid="ignore"):
        finite = np.nan_to_num(raw.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    per_second = 1e9 / unit.ns
    whole = np.floor(finite / per_second)
    rest = finite - whole * per_second
    return whole.astype(np.int64) * 1_000_000_000 + np.rint(rest * unit.ns).astype(np.int64)
