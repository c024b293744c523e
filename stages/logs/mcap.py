"""MCAP files, ROS 1 or ROS 2 inside, whole or cut.

The file is walked from its start by the lengths of its records; the summary at the end is not needed, so a file that
was cut reads like any other until the cut. Chunks are not decompressed while walking (their message indexes tell
times), unless a channel is declared only inside. Source: mcap.dev/spec, version 0.
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

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, DATA_END = 0x08, 0x0F
_FOOTER_SIZE = 9 + 20
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")


class McapFile(ChunkedFile):
    """One MCAP file, indexed by walking it."""

    def __init__(self, path: Path) -> None:
        self.profile = ""
        self._schemas: dict[int, str] = {}
        super().__init__(path)

    def _check_start(self) -> None:
        if bytes(self._bytes[:8]) != MAGIC:
            raise InvalidInput(
                "This is no MCAP file: its first bytes are not those of MCAP.",
                where=str(self.path),
                next_step="give a recorded .mcap, .bag or .db3 file, or the folder that holds it",
            )

    def _walk(self) -> None:
        at, size = len(MAGIC), len(self._bytes)
        run = LooseRun()
        ended = False
        while at + _HEAD.size <= size and not ended:
            op, length = _HEAD.unpack_from(self._bytes, at)
            begin, end = at + _HEAD.size, at + _HEAD.size + length
            if end > size or not self._note(op, begin, end, at, run):
                resumed = self._resume(at)
                if resumed is None:
                    self._cut(op, at, begin)
                    break
                self._lose(f"{(resumed - at) / 1e6:.2g} MB at {at / 1e6:.1f} MB are damaged", resumed - at)
                end = resumed
            if op != MESSAGE or run.full:
                self._blocks += run.take()
            at, ended = end, op == DATA_END
            self._file.passed(at)
        self._blocks += run.take()
        if not ended and not self.damage:
            self.damage.texts.append(
                "the end of the file is missing: it was cut, or its recording was not closed"
            )

    def _note(self, op: int, begin: int, end: int, at: int, run: LooseRun) -> bool:
        """One whole record; False when it makes no sense."""
        body = self._bytes[begin:end]
        try:
            if op == MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(body, 0)
                run.add(channel, log_ns, at, end)
            elif op == HEADER:
                self.profile = _text(body, 0)[0]
            elif op == SCHEMA:
                self._schema(body)
            elif op == CHANNEL:
                self._channel(body)
            elif op == CHUNK:
                self._blocks.append(_chunk(body, begin))
            elif op == MESSAGE_INDEX:
                self._message_index(body)
            elif op == 0 or (DATA_END < op < 0x80):
                raise DamageError("a record of unknown kind")
        except (DamageError, struct.error, ValueError):
            return False
        return True

    def _resume(self, at: int) -> int | None:
        """Where the next whole chunk begins after the damage at `at`: as the summary says, else by its looks."""
        starts = [offset for offset in self._summary() if offset > at]
        if starts:
            return min(starts)
        for mark in (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4"):
            found = self._file.find(mark, at + _HEAD.size + 29)
            while found >= 0:
                start = found - 28 - _HEAD.size
                op, length = _HEAD.unpack_from(self._bytes, start)
                if op == CHUNK and start + _HEAD.size + length <= len(self._bytes):
                    return start
                found = self._file.find(mark, found + 1)
        return None

    def _summary(self) -> list[int]:
        """Starts of all chunks by the summary at the end, whose schemas and channels are taken in; empty without one."""
        size = len(self._bytes)
        foot = size - len(MAGIC) - _FOOTER_SIZE
        if (
            foot < len(MAGIC)
            or bytes(self._bytes[size - len(MAGIC) :]) != MAGIC
            or self._bytes[foot] != FOOTER
        ):
            return []
        (at,) = struct.unpack_from("<Q", self._bytes, foot + _HEAD.size)
        starts: list[int] = []
        while 0 < at <= foot - _HEAD.size:
            op, length = _HEAD.unpack_from(self._bytes, at)
            body = self._bytes[at + _HEAD.size : at + _HEAD.size + length]
            try:
                if op == SCHEMA:
                    self._schema(body)
                elif op == CHANNEL:
                    self._channel(body)
                elif op == CHUNK_INDEX:
                    starts.append(struct.unpack_from("<Q", body, 16)[0])
            except (DamageError, struct.error, ValueError):
                return starts
            at += _HEAD.size + length
        return starts

    def _cut(self, op: int, at: int, begin: int) -> None:
        """Nothing whole follows; of a chunk that is cut the beginning can still be read."""
        if op == CHUNK:
            try:
                block = _chunk(self._bytes[begin:], begin)
                block.cut = True
                self._blocks.append(block)
            except (DamageError, struct.error, ValueError):
                pass
        lost = len(self._bytes) - at
        self._lose(
            f"the file was cut at {len(self._bytes) / 1e6:.1f} MB, its last {lost / 1e6:.2g} MB hold only a part of a record, "
            "and what was recorded after that is missing",
            lost,
        )

    def _index_unindexed(self) -> None:
        super()._index_unindexed()
        if any(channel not in self.channels for block in self._blocks for channel in block.stamps):
            self._summary()

    def _schema(self, body: memoryview) -> None:
        (number,) = struct.unpack_from("<H", body, 0)
        self._schemas[number] = _text(body, 2)[0]

    def _channel(self, body: memoryview) -> None:
        number, schema = struct.unpack_from("<HH", body, 0)
        topic, at = _text(body, 4)
        encoding, _ = _text(body, at)
        self.channels[number] = Channel(topic, self._schemas.get(schema, ""), encoding)

    def _message_index(self, body: memoryview) -> None:
        channel, size = struct.unpack_from("<HI", body, 0)
        entries = np.frombuffer(body[6 : 6 + size], "<u8").reshape(-1, 2)
        if self._blocks and len(entries):
            self._blocks[-1].stamps[channel] = entries[:, 0].astype(np.int64)

    def _records(self, data: memoryview, block: Block, channels: set[int] | None) -> Iterator[RawMessage]:
        at, size = 0, len(data)
        while at + _HEAD.size <= size:
            op, length = _HEAD.unpack_from(data, at)
            begin = at + _HEAD.size
            at = begin + length
            if at > size:
                if block.cut:
                    return
                raise DamageError("a message is longer than its chunk")
            if op == MESSAGE:
                if length > MAX_MESSAGE_BYTES:
                    raise DamageError(f"a message claims {length / 2**20:.0f} MiB")
                channel, _, log_ns, _ = _MESSAGE.unpack_from(data, begin)
                if channels is None or channel in channels:
                    yield RawMessage(log_ns, channel, data[begin + _MESSAGE.size : at])
            elif channels is None and op == SCHEMA:
                self._schema(data[begin:at])
            elif channels is None and op == CHANNEL:
                self._channel(data[begin:at])


def _chunk(body: memoryview, begin: int) -> Block:
    start_ns, _, size, crc = struct.unpack_from("<QQQI", body, 0)
    compression, at = _text(body, 28)
    (stored,) = struct.unpack_from("<Q", body, at)
    data = begin + at + 8
    return Block(start_ns, data, min(data + stored, begin + len(body)), compression, size, crc)


def _text(body: memoryview, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    if end > len(body):
        raise DamageError("a text is longer than its record")
    return bytes(body[at + 4 : end]).decode("utf-8", "replace"), end
