"""PCD files of the Point Cloud Library, version 0.7: `ascii`, `binary` and `binary_compressed` (LZF by columns)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.logs.pointtable import binary_table, needed_bytes, text_table

LONGEST_HEADER = 1 << 16


class PcdHeader(NamedTuple):
    """What a PCD file says about itself."""

    dtype: np.dtype[Any]
    points: int
    height: int
    kind: str
    start: int
    """Byte where the data start."""

    @property
    def least_bytes(self) -> int:
        """Bytes that must follow the header."""
        return needed_bytes(self.dtype, self.points) if self.kind == "binary" else 0


def read_pcd(data: bytes) -> tuple[NDArray[Any], int]:
    """Points (n,) as a structured array, and the number of rows of an organised cloud.

    Raises
    ------
    InvalidInput : not a PCD, or its data do not fit its header.
    """
    header = read_pcd_header(data)
    body = data[header.start :]
    if header.kind == "ascii":
        return text_table(body, header.dtype, header.points), header.height
    if header.kind == "binary":
        return binary_table(body, header.dtype, header.points), header.height
    return _unpack_columns(body, header.dtype, header.points), header.height


def read_pcd_header(data: bytes) -> PcdHeader:
    """The header, from the first bytes of a file; InvalidInput when it is none or contradicts itself."""
    entries, start = _entries(data)
    kind = entries["DATA"][0].lower() if entries["DATA"] else ""
    if kind not in ("ascii", "binary", "binary_compressed"):
        raise InvalidInput(f"has unknown DATA {kind or 'kind'}")
    height = _number(entries, "HEIGHT") if "HEIGHT" in entries else 1
    points = _number(entries, "POINTS") if "POINTS" in entries else _number(entries, "WIDTH") * height
    return PcdHeader(_dtype(entries), points, height, kind, start)


def _entries(data: bytes) -> tuple[dict[str, list[str]], int]:
    entries: dict[str, list[str]] = {}
    position = 0
    while position < min(len(data), LONGEST_HEADER):
        end = data.find(b"\n", position)
        if end < 0:
            break
        words = data[position:end].decode("ascii", "replace").split()
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        entries[words[0].upper()] = words[1:]
        if words[0].upper() == "DATA" and "FIELDS" in entries:
            return entries, position
    raise InvalidInput("is not a PCD file: its header has no FIELDS and DATA")


def _dtype(entries: dict[str, list[str]]) -> np.dtype[Any]:
    names = entries["FIELDS"]
    sizes, kinds = entries.get("SIZE", ["4"] * len(names)), entries.get("TYPE", ["F"] * len(names))
    counts = entries.get("COUNT", ["1"] * len(names))
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


def _number(entries: dict[str, list[str]], key: str) -> int:
    try:
        value = int(entries[key][0])
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
    if size != needed_bytes(dtype, points):
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
    i, o, count = np.int64(0), np.int64(0), np.int64(0)
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
    return int(o)
