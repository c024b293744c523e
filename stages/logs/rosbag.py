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
_CUT = "the file ends in the middle of a record"
_CHUNK_MARK = b"\x04\0\0\0op=\x05"


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
                op, end = self._note_next(at, size, run)
            except (DamageError, struct.error, ValueError, KeyError) as error:
                resumed = self._resume(at)
                if resumed is None:
                    self._stop(at, str(error))
                    break
                self._lose(
                    f"{(resumed - at) / 1e6:.2g} MB at {at / 1e6:.1f} MB are damaged ({error})", resumed - at
                )
                op, end = CHUNK, resumed
            if op != MESSAGE or run.full:
                self._blocks += run.take()
            at = end
            self._file.passed(at)
        self._blocks += run.take()
        if not self.damage and not 0 < self._index_at <= size:
            self.damage.texts.append(
                "the recording was not closed properly"
                if self._index_at == 0
                else self._missing("the end of the file")
            )

    def _note_next(self, at: int, size: int, run: LooseRun) -> tuple[int, int]:
        """Take in the record at `at`; its kind and where it ends."""
        fields, begin, end = self._head(at, size)
        op = _op(fields)
        if end > size:
            if op == CHUNK and self._resume(at) is None:
                self._cut(fields, begin, size)
            raise DamageError(_CUT)
        if op == MESSAGE:
            run.add(_connection_number(fields), _time_ns(fields), at, end)
        else:
            self._note(op, fields, begin, end)
        return op, end

    def _resume(self, at: int) -> int | None:
        """Where the next whole chunk begins after the damage at `at`."""
        found = self._file.find(_CHUNK_MARK, at + 1)
        while found >= 0:
            # the mark stands among the fields of a header whose length precedes it, 13 to 60 bytes before
            for start in range(found - 4, max(found - 64, at), -1):
                (length,) = struct.unpack_from("<I", self._bytes, start)
                if 8 <= found - start + 4 <= length + 4 <= 120 and self._is_chunk(start):
                    return start
            found = self._file.find(_CHUNK_MARK, found + 1)
        return None

    def _is_chunk(self, start: int) -> bool:
        try:
            fields, _, end = self._head(start, len(self._bytes))
            return _op(fields) == CHUNK and b"size" in fields and end <= len(self._bytes)
        except (DamageError, struct.error):
            return False

    def _head(self, at: int, size: int) -> tuple[dict[bytes, memoryview], int, int]:
        """Fields of the record at `at`, begin and end of its data (the end may lie beyond the file)."""
        (length,) = struct.unpack_from("<I", self._bytes, at)
        if length > _MAX_HEADER:
            raise DamageError("a record's header is longer than it can be")
        fields_end = at + 4 + length
        if fields_end + 4 > size:
            raise DamageError(_CUT)
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

    def _cut(self, fields: dict[bytes, memoryview], begin: int, size: int) -> None:
        """Of a chunk that is cut the beginning can still be read."""
        try:
            block = _chunk(fields, begin, size)
            block.cut = True
            self._blocks.append(block)
        except (struct.error, KeyError):
            pass

    def _stop(self, at: int, why: str) -> None:
        """Nothing whole follows."""
        size = len(self._bytes)
        text = f"the file was cut at {size / 1e6:.1f} MB, its last {(size - at) / 1e6:.2g} MB hold only a part of a record"
        if why != _CUT:
            text = f"the file is damaged from {at / 1e6:.1f} MB on ({why})"
        self._lose(self._missing(text), size - at)

    def _missing(self, text: str) -> str:
        """How much of the file there was, as its header tells when the recording was closed."""
        size = len(self._bytes)
        if self._index_at > size:
            return f"{text}; {100 * (1 - size / self._index_at):.0f} % of the log is missing"
        return f"{text}, and what was recorded after that is missing" if not self._index_at else text

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
