"""ROS 1 bags, version 2.0: closed or not, whole or cut, every compression.

Like MCAP the file is walked from its start, so that a bag without index (a recording that was not closed) reads like
any other. Source: ROS wiki, "Bags/Format/2.0".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.logs.containers import (
    MAX_MESSAGE_BYTES,
    Block,
    Channel,
    ChunkedFile,
    DamageError,
    LooseRun,
    RawMessage,
)

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
_MAX_HEADER = 1 << 20


class Rosbag1File(ChunkedFile):
    """One .bag file, indexed by walking it."""

    def __init__(self, path: Path) -> None:
        self._index_at = 0
        super().__init__(path)

    def _check_start(self) -> None:
        head = bytes(self._bytes[:16])
        if head.startswith(MAGIC):
            return
        old = head.startswith(b"#ROSBAG V1")
        raise InvalidInput(
            "This bag is of format 1.x, which has not been written since 2010."
            if old
            else "This is no ROS bag: its first bytes are not those of a bag.",
            where=str(self.path),
            next_step="convert it with `rosbag fix`" if old else "give a recorded .bag, .mcap or .db3 file",
        )

    def _walk(self) -> None:
        at, size = len(MAGIC), len(self._bytes)
        run = LooseRun()
        while at < size:
            try:
                fields, begin, end = self._head(at, size)
                op = _op(fields)
                if end > size:
                    self._cut(op, fields, begin, size)
                    break
                if op == MESSAGE:
                    run.add(_connection_number(fields), _time_ns(fields), at, end)
                else:
                    self._note(op, fields, begin, end)
            except (DamageError, struct.error, ValueError, KeyError) as error:
                self._stop(at, str(error))
                break
            if op != MESSAGE or run.full:
                self._blocks += run.take()
            at = end
        self._blocks += run.take()
        if not self.damage and not 0 < self._index_at <= size:
            self.damage.texts.append(
                "the recording was not closed properly"
                if self._index_at == 0
                else "the end of the file is missing"
            )

    def _head(self, at: int, size: int) -> tuple[dict[bytes, memoryview], int, int]:
        """Fields of the record at `at`, begin and end of its data (the end may lie beyond the file)."""
        (length,) = struct.unpack_from("<I", self._bytes, at)
        if length > _MAX_HEADER:
            raise DamageError("a record's header is longer than it can be")
        fields_end = at + 4 + length
        if fields_end + 4 > size:
            raise DamageError("the file ends in the middle of a record")
        fields = _fields(self._bytes[at + 4 : fields_end])
        (data,) = struct.unpack_from("<I", self._bytes, fields_end)
        return fields, fields_end + 4, fields_end + 4 + data

    def _note(self, op: int, fields: dict[bytes, memoryview], begin: int, end: int) -> None:
        body = self._bytes[begin:end]
        if op == BAG_HEADER:
            (self._index_at,) = struct.unpack("<Q", fields[b"index_pos"])
        elif op == CHUNK:
            self._blocks.append(_chunk(fields, begin, end))
        elif op == INDEX and self._blocks:
            self._index(fields, body)
        elif op == CONNECTION:
            self._connection(fields, body)
        elif op not in (INDEX, CHUNK_INFO):
            raise DamageError("a record of unknown kind")

    def _index(self, fields: dict[bytes, memoryview], body: memoryview) -> None:
        entries = np.frombuffer(body, "<u4").reshape(-1, 3).astype(np.int64)
        if len(entries):
            stamps = entries[:, 0] * 1_000_000_000 + entries[:, 1]
            block = self._blocks[-1]
            block.start_ns = min(int(stamps.min()), block.start_ns) if block.stamps else int(stamps.min())
            block.stamps[_connection_number(fields)] = stamps

    def _connection(self, fields: dict[bytes, memoryview], body: memoryview) -> None:
        inner = _fields(body)
        topic = bytes(fields.get(b"topic", b"")) or bytes(inner.get(b"topic", b""))
        kind = bytes(inner.get(b"type", b""))
        self.channels[_connection_number(fields)] = Channel(
            topic.decode("utf-8", "replace"), kind.decode("utf-8", "replace"), "ros1"
        )

    def _cut(self, op: int, fields: dict[bytes, memoryview], begin: int, size: int) -> None:
        """The last record is incomplete; of a chunk the beginning can still be read."""
        if op == CHUNK:
            try:
                block = _chunk(fields, begin, size)
                block.cut = True
                self._blocks.append(block)
            except (DamageError, struct.error, KeyError):
                pass
        self._stop(begin, "the file ends in the middle of a record")

    def _stop(self, at: int, why: str) -> None:
        size = len(self._bytes)
        cut = "ends in the middle" in why
        self._lose(
            f"the file ends in the middle of a record, at {size / 1e6:.1f} MB: it was cut, and what was recorded after "
            "that is missing"
            if cut
            else f"the file is damaged at {at / 1e6:.1f} MB ({why})",
            size - at,
        )

    def _records(self, data: memoryview, block: Block, channels: set[int] | None) -> Iterator[RawMessage]:
        at, size = 0, len(data)
        while at + 4 <= size:
            (length,) = struct.unpack_from("<I", data, at)
            fields_end = at + 4 + length
            if fields_end + 4 > size:
                if block.cut or block.loose:
                    return
                raise DamageError("a record is longer than its chunk")
            fields = _fields(data[at + 4 : fields_end])
            (length,) = struct.unpack_from("<I", data, fields_end)
            begin = fields_end + 4
            at = begin + length
            if at > size:
                if block.cut or block.loose:
                    return
                raise DamageError("a message is longer than its chunk")
            op = _op(fields)
            if op == MESSAGE:
                if length > MAX_MESSAGE_BYTES:
                    raise DamageError(f"a message claims {length / 2**20:.0f} MiB")
                number = _connection_number(fields)
                if channels is None or number in channels:
                    yield RawMessage(_time_ns(fields), number, data[begin:at])
            elif op == CONNECTION and channels is None:
                self._connection(fields, data[begin:at])


def _chunk(fields: dict[bytes, memoryview], begin: int, end: int) -> Block:
    (size,) = struct.unpack("<I", fields[b"size"])
    return Block(0, begin, end, bytes(fields[b"compression"]).decode("ascii", "replace"), size)


def _fields(header: memoryview) -> dict[bytes, memoryview]:
    """`name=value` pairs of a record's header."""
    fields: dict[bytes, memoryview] = {}
    at = 0
    while at + 4 <= len(header):
        (length,) = struct.unpack_from("<I", header, at)
        item = header[at + 4 : at + 4 + length]
        if len(item) != length:
            raise DamageError("a field is longer than its header")
        name = bytes(item[:64]).partition(b"=")[0]
        if len(name) == len(item[:64]):
            raise DamageError("a field without a name")
        fields[name] = item[len(name) + 1 :]
        at += 4 + length
    return fields


def _op(fields: dict[bytes, memoryview]) -> int:
    op = fields.get(b"op")
    if op is None or len(op) != 1:
        raise DamageError("a record without a kind")
    return op[0]


def _connection_number(fields: dict[bytes, memoryview]) -> int:
    try:
        return int(struct.unpack("<I", fields[b"conn"])[0])
    except KeyError:
        raise DamageError("a record without its connection") from None


def _time_ns(fields: dict[bytes, memoryview]) -> int:
    try:
        seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
    except KeyError:
        raise DamageError("a message without a time") from None
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
