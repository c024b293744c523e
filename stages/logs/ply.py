"""PLY files (Turk's polygon format), text and both binary orders; of their elements only `vertex` is read."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.logs.pointtable import binary_table, needed_bytes, text_table

LONGEST_HEADER = 1 << 16
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


class PlyHeader(NamedTuple):
    """What a PLY file says about itself."""

    dtype: np.dtype[Any]
    points: int
    text: bool
    start: int
    """Byte where the data start."""

    @property
    def least_bytes(self) -> int:
        """Bytes that must follow the header."""
        return 0 if self.text else needed_bytes(self.dtype, self.points)


def read_ply(data: bytes) -> NDArray[Any]:
    """Vertices (n,) as a structured array.

    Raises
    ------
    InvalidInput : not a PLY, its vertices are not its first element or hold lists, or its data are cut short.
    """
    header = read_ply_header(data)
    read = text_table if header.text else binary_table
    return read(data[header.start :], header.dtype, header.points)


def read_ply_header(data: bytes) -> PlyHeader:
    """The header, from the first bytes of a file; InvalidInput when it is none or says what is not read."""
    end = data.find(b"end_header", 0, LONGEST_HEADER)
    line = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line < 0:
        raise InvalidInput("is not a PLY file: its header does not end")
    order, points = "", -1
    columns: dict[str, str] = {}
    inside = False
    for words in (text.split() for text in data[:end].decode("ascii", "replace").splitlines()):
        if words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1], "")
        elif words[:1] == ["element"] and len(words) == 3:
            inside = words[1] == "vertex"
            points = _points(words, inside, points)
        elif words[:1] == ["property"] and inside:
            name, kind = _property(words, columns)
            columns[name] = kind
    if not order or points < 0 or not columns:
        raise InvalidInput("has a PLY header without format, vertices or properties")
    return PlyHeader(np.dtype([(n, order + k) for n, k in columns.items()]), points, order == "=", line + 1)


def _points(words: list[str], vertices: bool, points: int) -> int:
    if vertices and words[2].isdigit():
        return int(words[2])
    if points < 0:
        raise InvalidInput(f"has a PLY element {words[1]} before its vertices, which is not read")
    return points


def _property(words: list[str], columns: dict[str, str]) -> tuple[str, str]:
    if len(words) != 3 or words[1] not in _PLY_TYPES or words[2] in columns:
        raise InvalidInput(f"has a vertex property that is not read: {' '.join(words[1:])}")
    return words[2], _PLY_TYPES[words[1]]
