"""Folders of scans, one file each, as a log: PCD, PLY and KITTI's `.bin`.

PCD: the format of the Point Cloud Library, version 0.7, `ascii`, `binary` and `binary_compressed` (LZF by columns).
PLY: Turk's polygon format, `ascii` and both binary orders; of its elements only `vertex` is read.
Headers become a numpy structured dtype, so ring and time columns survive whatever their names and types.
"""

from __future__ import annotations

import io
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import Problem, RawLog
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.logs.kitti import FolderLog, read_velodyne
from scanloom.stages.logs.pointcloud import cloud_from_table
from scanloom.stages.logs.records import Cloud, CloudFile

TOPIC = "scans"
SUFFIXES = (".pcd", ".ply", ".bin")
MOST_BYTES = 2 << 30
"""A compressed PCD that claims more than this is damaged, not big."""

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


def open_point_files(raw_log: RawLog, rate_hz: float = 10.0) -> FolderLog:
    """A folder of PCD, PLY or `.bin` scans in natural order of their names.

    Stamps are the names where these are times (`1317042164.103500`, or 16 to 19 digits of us or ns); else the scans
    follow each other at `rate_hz`. Files that cannot be read are named and the others go on.

    Raises
    ------
    InvalidInput : the folder holds no such file, or none that can be read.
    """
    names = sorted((n for n in raw_log.names if Path(n).suffix.lower() in SUFFIXES), key=natural)
    if not names:
        raise InvalidInput(
            "holds no scans",
            where=str(raw_log.root or ""),
            next_step=f"give files ending in {', '.join(SUFFIXES)}",
        )
    problems: list[Problem] = []
    stamps = _stamps(names, rate_hz, problems)
    scans = []
    for name, stamp_ns in zip(names, stamps):
        path = raw_log.path(name)
        try:
            _look(path)
        except InvalidInput as error:
            text = f"{name} {error.what}; left out"
            problems.append(
                Problem(code="points.broken", severity="warning", text=text, topic=TOPIC, stamp_ns=stamp_ns)
            )
            continue
        scans.append(CloudFile(stamp_ns, stamp_ns, partial(read_points, path, stamp_ns), str(path)))
    if not scans:
        raise InvalidInput(
            f"none of {len(names)} scan files can be read; {problems[-1].text}",
            where=str(raw_log.root or ""),
            next_step="check that the files are complete",
        )
    scans.sort(key=lambda scan: scan.stamp_ns)
    return FolderLog("point files", scans, {}, (), tuple(problems), scan_topic=TOPIC)


def read_points(path: Path, stamp_ns: int) -> Cloud:
    """One scan from a PCD, PLY or `.bin` file.

    Raises
    ------
    InvalidInput : the file is damaged, cut short, or holds no x, y, z.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return replace(read_velodyne(path, stamp_ns, beams=None), sweep=None, stamp_at="start")
    try:
        data = path.read_bytes()
        table, height = read_pcd(data) if suffix == ".pcd" else read_ply(data)
        return cloud_from_table(table, stamp_ns, height=height)
    except OSError as error:
        raise InvalidInput(f"cannot be read: {error.strerror}", where=str(path)) from error
    except InvalidInput as error:
        raise InvalidInput(error.what, where=str(path), next_step=error.next_step) from error


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts `scan_9` before `scan_10`."""
    return tuple((0, int(p), "") if p.isdigit() else (1, 0, p) for p in re.split(r"(\d+)", name) if p)


def stamp_from_name(name: str) -> int | None:
    """Stamp, ns, of a file named after its time, within the years 2001 to 2100; None for a plain number."""
    stem = Path(name).stem
    found = re.fullmatch(r"(?:.*\D)?(\d{10})[._-](\d{1,9})", stem)
    if found and _plausible(seconds := int(found[1])):
        fraction = found[2]
        return seconds * 1_000_000_000 + int(fraction.ljust(9, "0"))
    found = re.fullmatch(r"(?:.*\D)?(\d{16}|\d{19})", stem)
    if found:
        value = int(found[1]) * (1000 if len(found[1]) == 16 else 1)
        return value if _plausible(value // 1_000_000_000) else None
    return None


# --- PCD -------------------------------------------------------------------------------------------------------------


def read_pcd(data: bytes) -> tuple[NDArray[Any], int]:
    """Points (n,) as a structured array, and the number of rows of an organised cloud.

    Raises
    ------
    InvalidInput : not a PCD, or its data do not fit its header.
    """
    header, body = _pcd_header(data)
    dtype = _pcd_dtype(header)
    points = _number(
        header, "POINTS", default=_number(header, "WIDTH") * _number(header, "HEIGHT", default=1)
    )
    height = _number(header, "HEIGHT", default=1)
    if points * dtype.itemsize > MOST_BYTES:
        raise InvalidInput(f"claims {points} points, more than can be true")
    kind = header["DATA"][0].lower() if header["DATA"] else ""
    if kind == "ascii":
        return _ascii_table(body, dtype, points), height
    if kind == "binary":
        return _binary_table(body, dtype, points), height
    if kind == "binary_compressed":
        return _unpack_columns(body, dtype, points), height
    raise InvalidInput(f"has unknown DATA {kind or 'kind'}")


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    position = 0
    while position < min(len(data), 1 << 16):
        end = data.find(b"\n", position)
        if end < 0:
            break
        words = data[position:end].decode("ascii", "replace").split()
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        header[words[0].upper()] = words[1:]
        if words[0].upper() == "DATA":
            if "FIELDS" not in header:
                break
            return header, data[position:]
    raise InvalidInput("is not a PCD file: its header has no FIELDS and DATA")


def _pcd_dtype(header: dict[str, list[str]]) -> np.dtype[Any]:
    names = header["FIELDS"]
    sizes, kinds = header.get("SIZE", ["4"] * len(names)), header.get("TYPE", ["F"] * len(names))
    counts = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise InvalidInput("has a PCD header whose FIELDS, SIZE, TYPE and COUNT differ in length")
    columns: list[Any] = []
    for i, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts)):
        try:
            cell = np.dtype("<" + {"F": "f", "I": "i", "U": "u"}[kind.upper()] + str(int(size)))
            shape = () if int(count) == 1 else (int(count),)
            unique = name if name not in ("_", *(column[0] for column in columns)) else f"_{i}"
            columns.append((unique, cell, shape))
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInput(f"field {name} has unknown type {kind}{size}") from error
    return np.dtype(columns)


def _number(header: dict[str, list[str]], key: str, *, default: int | None = None) -> int:
    if key not in header and default is not None:
        return default
    try:
        value = int(header[key][0])
    except (KeyError, IndexError, ValueError) as error:
        raise InvalidInput(f"has a PCD header without a number for {key}") from error
    if value < 0:
        raise InvalidInput(f"has a PCD header with {key} {value}")
    return value


def _unpack_columns(body: bytes, dtype: np.dtype[Any], points: int) -> NDArray[Any]:
    """`binary_compressed`: two sizes, then LZF over the columns one after the other."""
    if len(body) < 8:
        raise InvalidInput("ends before its compressed data")
    packed, size = (int(v) for v in np.frombuffer(body[:8], "<u4"))
    if size != points * dtype.itemsize:
        raise InvalidInput(f"unpacks to {size} bytes where {points} points need {points * dtype.itemsize}")
    if len(body) < 8 + packed:
        raise InvalidInput(f"is cut short: {len(body) - 8} of {packed} compressed bytes")
    flat = np.empty(size, np.uint8)
    if _lzf(np.frombuffer(body, np.uint8, packed, 8), flat) != size:
        raise InvalidInput("has damaged compressed data")
    table = np.empty(points, dtype)
    start = 0
    for name in dtype.names or ():
        width = dtype[name].itemsize * points
        table[name] = flat[start : start + width].view(dtype[name].base).reshape(points, *dtype[name].shape)
        start += width
    return table


@kernel
def _lzf(packed: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """LZF: a byte below 32 starts that many plus one literals, else a copy from earlier output. -1 when damaged."""
    i, o = 0, 0
    while i < len(packed):
        control = np.int64(packed[i])
        i += 1
        if control < 32:
            count = control + 1
            if i + count > len(packed) or o + count > len(out):
                return -1
            for k in range(count):
                out[o + k] = packed[i + k]
            i += count
        else:
            count = control >> 5
            if count == 7:
                if i >= len(packed):
                    return -1
                count += np.int64(packed[i])
                i += 1
            if i >= len(packed):
                return -1
            source = o - ((control & 31) << 8) - np.int64(packed[i]) - 1
            i += 1
            count += 2
            if source < 0 or o + count > len(out):
                return -1
            for k in range(count):
                out[o + k] = out[source + k]
        o += count
    return o


# --- PLY -------------------------------------------------------------------------------------------------------------


def read_ply(data: bytes) -> tuple[NDArray[Any], int]:
    """Vertices (n,) as a structured array, and 1 for the number of rows.

    Raises
    ------
    InvalidInput : not a PLY, its vertices are not its first element or hold lists, or its data are cut short.
    """
    end = data.find(b"end_header", 0, 1 << 20)
    line = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line < 0:
        raise InvalidInput("is not a PLY file: its header does not end")
    order, columns, count = _ply_header(data[:end].decode("ascii", "replace").splitlines())
    dtype = np.dtype([(name, order + kind) for name, kind in columns])
    if count * dtype.itemsize > MOST_BYTES:
        raise InvalidInput(f"claims {count} points, more than can be true")
    body = data[line + 1 :]
    if order == "=":
        return _ascii_table(body, dtype, count), 1
    return _binary_table(body, dtype, count), 1


def _ply_header(lines: list[str]) -> tuple[str, list[tuple[str, str]], int]:
    order, count = "", -1
    columns: list[tuple[str, str]] = []
    inside = False
    for words in (line.split() for line in lines):
        if words[:1] == ["format"] and len(words) > 1:
            order = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}.get(words[1], "")
        elif words[:1] == ["element"] and len(words) == 3:
            inside = words[1] == "vertex"
            if not inside and count < 0:
                raise InvalidInput(f"has a PLY element {words[1]} before its vertices, which is not read")
            count = int(words[2]) if inside and words[2].isdigit() else count
        elif words[:1] == ["property"] and inside:
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise InvalidInput(f"has a vertex property that is not read: {' '.join(words[1:])}")
            columns.append((words[2], _PLY_TYPES[words[1]]))
    if not order or count < 0 or not columns:
        raise InvalidInput("has a PLY header without format, vertices or properties")
    return order, columns, count


# ---------------------------------------------------------------------------------------------------------------------


def _binary_table(body: bytes, dtype: np.dtype[Any], points: int) -> NDArray[Any]:
    needed = points * dtype.itemsize
    if len(body) < needed:
        raise InvalidInput(f"is cut short: {len(body)} of {needed} bytes of points")
    return np.frombuffer(body, dtype, points)


def _ascii_table(body: bytes, dtype: np.dtype[Any], points: int) -> NDArray[Any]:
    """Numbers separated by blanks, one point a line; columns of several numbers take that many."""
    widths = [int(np.prod(dtype[name].shape, dtype=int)) for name in dtype.names or ()]
    try:
        values = np.loadtxt(io.BytesIO(body), dtype=np.float64, max_rows=points, ndmin=2, comments=None)
    except ValueError as error:
        raise InvalidInput(f"holds a line that is no point: {error}") from error
    if points and (len(values) < points or values.shape[1] < sum(widths)):
        raise InvalidInput(f"is cut short: {len(values)} of {points} points with {sum(widths)} numbers")
    table = np.zeros(points, dtype)
    start = 0
    for name, width in zip(dtype.names or (), widths):
        table[name] = (
            values[:, start : start + width].reshape(points, *dtype[name].shape) if points else table[name]
        )
        start += width
    return table


def _look(path: Path) -> None:
    """Raise InvalidInput when the head of a file already shows that it cannot be read."""
    size = path.stat().st_size
    if size == 0:
        raise InvalidInput("is empty")
    suffix = path.suffix.lower()
    if suffix == ".bin" and size < 16:
        raise InvalidInput(f"holds no point ({size} bytes)")
    if suffix == ".bin":
        return
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    if suffix == ".pcd":
        header, body = _pcd_header(head)
        dtype = _pcd_dtype(header)
        binary = header["DATA"] == ["binary"]
        points = _number(header, "POINTS", default=0)
        offset = len(head) - len(body)
    else:
        end = head.find(b"end_header")
        if not head.startswith(b"ply") or end < 0:
            raise InvalidInput("is not a PLY file: its header does not end")
        order, columns, points = _ply_header(head[:end].decode("ascii", "replace").splitlines())
        dtype = np.dtype([(name, order + kind) for name, kind in columns])
        binary, offset = order != "=", head.find(b"\n", end) + 1
    needed = points * dtype.itemsize
    if binary and size - offset < needed:
        raise InvalidInput(f"is cut short: {size - offset} of {needed} bytes of points")
    if not {"x", "y", "z"} <= set(dtype.names or ()):
        raise InvalidInput("has no x, y, z")


def _stamps(names: list[str], rate_hz: float, problems: list[Problem]) -> list[int]:
    """Stamps from the names when all of them are times, else one per period."""
    stamps = [stamp for name in names if (stamp := stamp_from_name(name)) is not None]
    if len(stamps) == len(names) and len(set(stamps)) == len(stamps):
        return stamps
    text = f"file names are not times; {rate_hz:g} scans per second are assumed"
    problems.append(Problem(code="points.rate_assumed", severity="info", text=text, topic=TOPIC))
    return [round(i * 1e9 / rate_hz) for i in range(len(names))]


def _plausible(seconds: int) -> bool:
    return 978_307_200 <= seconds < 4_102_444_800
