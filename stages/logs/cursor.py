"""Reads the primitives of a ROS message one after the other, in CDR (ROS 2) and in ROS 1 serialization."""

from __future__ import annotations

import struct
from typing import Any

_MAX_NAME = 4096
_MAX_ITEMS = 4096


class Cursor:
    """Reads primitives one after the other. Raises ValueError where the bytes end or make no sense."""

    __slots__ = ("_align_max", "_base", "at", "data", "order", "ros1")

    def __init__(self, data: memoryview, encoding: str) -> None:
        self.data = data
        self.ros1 = encoding == "ros1"
        self.order = "<"
        self.at = self._base = 0
        self._align_max = 1 if self.ros1 else 8
        if not self.ros1:
            if len(data) < 4:
                raise ValueError("message is empty")
            # encapsulation: 0/1 CDR big/little endian, 6/7 plain CDR2 (aligned to 4 at most)
            kind = data[1]
            if data[0] != 0 or kind not in (0, 1, 6, 7):
                raise ValueError(f"unknown CDR encapsulation {data[0]:02x}{kind:02x}")
            self.order = "<" if kind & 1 else ">"
            self._align_max = 4 if kind > 5 else 8
            self.at = self._base = 4

    def read(self, code: str, count: int = 1) -> tuple[Any, ...]:
        """`count` primitives of one struct code, aligned to their own size."""
        size = struct.calcsize(code)
        self.align(size)
        try:
            values = struct.unpack_from(f"{self.order}{count}{code}", self.data, self.at)
        except struct.error as error:
            raise ValueError("message ends early") from error
        self.at += size * count
        return values

    def align(self, size: int) -> None:
        step = min(size, self._align_max)
        self.at += -(self.at - self._base) % step

    def number(self, code: str) -> Any:
        return self.read(code)[0]

    def doubles(self, count: int) -> tuple[float, ...]:
        return self.read("d", count)

    def length(self, limit: int = _MAX_ITEMS) -> int:
        count = int(self.number("I"))
        if count > limit:
            raise ValueError(f"a length of {count} makes no sense here")
        return count

    def text(self) -> str:
        raw = self.take(self.length(_MAX_NAME))
        return bytes(raw).rstrip(b"\0").decode("utf-8", "replace")

    def take(self, count: int) -> memoryview:
        if self.at + count > len(self.data):
            raise ValueError("message ends early")
        piece = self.data[self.at : self.at + count]
        self.at += count
        return piece

    def time_ns(self) -> int:
        seconds, nanoseconds = self.number("I" if self.ros1 else "i"), self.number("I")
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def header(self) -> tuple[int, str]:
        """Stamp in ns and frame, without the leading slash of old tf."""
        if self.ros1:
            self.number("I")
        stamp_ns = self.time_ns()
        return stamp_ns, self.text().lstrip("/")
