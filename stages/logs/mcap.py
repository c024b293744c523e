"""MCAP files, ROS 1 or ROS 2 inside, whole or cut.

The file is walked from its start by the lengths of its records; the summary at the end is not needed, so a file that
was cut reads like any other until the cut. Chunks are not decompressed while walking (their message indexes tell
times), unless a channel is declared only inside. Source: mcap.dev/spec, version 0.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.logs.containers import (
    MAX_MESSAGE_BYTES,
    Block,
    Channel,
    DamageError,
    RawMessage,
    StampLists,
    decompress,
    in_time_order,
    map_file,
    merge_stamps,
)
from scanloom.stages.logs.records import Damage

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
DATA_END = 0x0F
_LOOSE_PER_BLOCK = 4096
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")


@dataclass
class _Chunk(Block):
    compression: str
    crc: int
    size: int
    data: tuple[int, int]
    """Begin and end in the file."""
    cut: bool = False
    loose: bool = False


@dataclass
class McapFile:
    """One MCAP file, indexed by walking it."""

    path: Path
    damage: Damage = field(default_factory=Damage)
    channels: dict[int, Channel] = field(default_factory=dict)
    profile: str = ""

    def __post_init__(self) -> None:
        self._bytes = map_file(self.path)
        if bytes(self._bytes[:8]) != MAGIC:
            raise InvalidInput(
                "This is no MCAP file: its first bytes are not those of MCAP.", where=str(self.path),
                next_step="give a recorded .mcap, .bag or .db3 file, or the folder that holds it",
            )  # fmt: skip
        self._schemas: dict[int, str] = {}
        self._blocks: list[_Chunk] = []
        self._walk()
        self._blocks.sort(key=lambda block: block.start_ns)

    @property
    def stamps(self) -> dict[int, NDArray[np.int64]]:
        return merge_stamps(self._blocks)

    def read(self, channels: set[int]) -> Iterator[RawMessage]:
        wanted = [block for block in self._blocks if not channels.isdisjoint(block.stamps)]
        return in_time_order((block.start_ns, partial(self._load, block, channels)) for block in wanted)

    # -- walking ------------------------------------------------------------------------------------------------------

    def _walk(self) -> None:
        at = len(MAGIC)
        loose: _Loose | None = None
        ended = False
        while at + _HEAD.size <= len(self._bytes):
            op, length = _HEAD.unpack_from(self._bytes, at)
            begin, end = at + _HEAD.size, at + _HEAD.size + length
            if end > len(self._bytes):
                self._cut(op, at, begin)
                break
            if op == MESSAGE:
                loose = loose or _Loose(at)
                loose.add(self._bytes[begin:end], end)
                if loose.count >= _LOOSE_PER_BLOCK:
                    self._blocks.append(loose.block())
                    loose = None
            elif not self._note(op, begin, end, at):
                break
            at = end
            if op == DATA_END:
                ended = True
                break
        if loose is not None:
            self._blocks.append(loose.block())
        self._index_unindexed()
        if not ended and not self.damage:
            self.damage.texts.append("the end of the file is missing (it was cut between two records)")

    def _note(self, op: int, begin: int, end: int, at: int) -> bool:
        """One whole record; False when it makes no sense and walking must stop."""
        body = self._bytes[begin:end]
        try:
            if op == HEADER:
                self.profile = _text(body, 0)[0]
            elif op == SCHEMA:
                self._schema(body)
            elif op == CHANNEL:
                self._channel(body)
            elif op == CHUNK:
                self._blocks.append(_chunk(body, begin))
            elif op == MESSAGE_INDEX:
                self._message_index(body)
            elif op == 0 or (op > DATA_END and op < 0x80):
                raise DamageError("a record of unknown kind")
        except (DamageError, struct.error, ValueError) as error:
            self._lose(f"the file is damaged at {at / 1e6:.1f} MB ({error})", len(self._bytes) - at)
            return False
        return True

    def _cut(self, op: int, at: int, begin: int) -> None:
        """The last record is incomplete."""
        lost = len(self._bytes) - at
        if op == CHUNK:
            try:
                block = _chunk(self._bytes[begin:], begin)
                block.cut = True
                self._blocks.append(block)
            except (DamageError, struct.error, ValueError):
                pass
        self._lose(
            f"the file ends in the middle of a record, at {len(self._bytes) / 1e6:.1f} MB: it was cut, "
            "and what was recorded after that is missing",
            lost,
        )

    def _lose(self, text: str, lost_bytes: int) -> None:
        self.damage.texts.append(text)
        self.damage.lost_bytes += lost_bytes

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

    def _index_unindexed(self) -> None:
        """Look inside chunks whose index is missing, or whose channels are declared only inside."""
        for block in self._blocks:
            if block.loose:
                continue
            known = all(channel in self.channels for channel in block.stamps)
            if known and block.stamps and not block.cut:
                continue
            stamps = StampLists()
            for message in self._messages(block, None):
                stamps.add(message.channel, message.receive_ns)
            if not block.stamps:
                block.stamps = stamps.arrays()

    # -- reading ------------------------------------------------------------------------------------------------------

    def _load(self, block: _Chunk, channels: set[int]) -> list[RawMessage]:
        return list(self._messages(block, channels))

    def _messages(self, block: _Chunk, channels: set[int] | None) -> Iterator[RawMessage]:
        """Messages of a chunk; with `channels` None it also learns the chunk's schemas and channels."""
        try:
            data = memoryview(self._open(block))
            yield from self._records(data, block, channels)
        except (DamageError, struct.error, ValueError) as error:
            begin, end = block.data
            text = f"a part of {(end - begin) / 1e6:.1f} MB at {begin / 1e6:.1f} MB is lost: {error}"
            if text not in self.damage.texts and not block.cut:
                self._lose(text, end - begin)

    def _open(self, block: _Chunk) -> bytes | memoryview:
        begin, end = block.data
        data = self._bytes[begin:end]
        if block.loose:
            return data
        out = decompress(block.compression, data, block.size, partial=block.cut)
        if block.crc and not block.cut and zlib.crc32(out) != block.crc:
            raise DamageError("the checksum of the chunk is wrong")
        return out

    def _records(self, data: memoryview, block: _Chunk, channels: set[int] | None) -> Iterator[RawMessage]:
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


class _Loose:
    """A run of messages outside chunks."""

    def __init__(self, begin: int) -> None:
        self.begin = self.end = begin
        self.count = 0
        self.stamps = StampLists()

    def add(self, body: memoryview, end: int) -> None:
        channel, _, log_ns, _ = _MESSAGE.unpack_from(body, 0)
        self.stamps.add(channel, log_ns)
        self.end = end
        self.count += 1

    def block(self) -> _Chunk:
        stamps = self.stamps.arrays()
        start_ns = min(int(values.min()) for values in stamps.values())
        return _Chunk(
            start_ns, self.begin, stamps, "", 0, self.end - self.begin, (self.begin, self.end), loose=True
        )


def _chunk(body: memoryview, begin: int) -> _Chunk:
    start_ns, _, size, crc = struct.unpack_from("<QQQI", body, 0)
    compression, at = _text(body, 28)
    (stored,) = struct.unpack_from("<Q", body, at)
    data = begin + at + 8
    return _Chunk(start_ns, begin, {}, compression, crc, size, (data, min(data + stored, begin + len(body))))


def _text(body: memoryview, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    if end > len(body):
        raise DamageError("a text is longer than its record")
    return bytes(body[at + 4 : end]).decode("utf-8", "replace"), end
