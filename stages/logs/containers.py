"""What the bag formats have in common: channels, blocks of messages, time order, bounded decompression."""

from __future__ import annotations

import bz2
import mmap
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.logs.records import Damage

MAX_CHUNK_BYTES = 1 << 30
"""No recorder writes larger chunks; a file that declares one is damaged or hostile."""
MAX_MESSAGE_BYTES = 256 << 20
"""No cloud or image is larger."""
_RELEASE_BYTES = 32 << 20


class DamageError(Exception):
    """Part of a container cannot be read; caught inside `stages.logs` and told as damage."""


@dataclass(frozen=True)
class Channel:
    """A stream inside one container file."""

    topic: str
    type: str
    encoding: str
    """`cdr`, `ros1`, or what else the file says."""


class RawMessage(NamedTuple):
    """A message still in its bytes, with the number of its channel."""

    receive_ns: int
    channel: int
    data: memoryview


@dataclass
class Block:
    """Messages that are read together: a chunk, or a run of loose messages."""

    start_ns: int
    begin: int
    end: int
    """Where the (compressed) data stands in the file."""
    compression: str
    size: int
    """Declared size of the data when decompressed."""
    crc: int = 0
    """CRC-32 of the decompressed data; 0 when not given."""
    cut: bool = False
    """The file ends before the data does."""
    loose: bool = False
    """Messages that stand in the file itself, in no chunk."""
    stamps: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    """Receive times per channel, as the index tells."""


class Container(Protocol):
    """One file of a log, opened and indexed, its messages not yet read."""

    @property
    def path(self) -> Path: ...

    @property
    def damage(self) -> Damage: ...

    @property
    def channels(self) -> dict[int, Channel]: ...

    @property
    def stamps(self) -> dict[int, NDArray[np.int64]]:
        """Receive times of all messages, per channel."""

    def read(self, channels: set[int]) -> Iterator[RawMessage]:
        """Messages of the channels in order of receive time."""


class ChunkedFile:
    """A file of chunks of messages: what MCAP and rosbag1 have in common.

    A subclass walks the records of the file once (`_walk`) and splits a chunk into messages (`_records`). Chunks whose
    index tells their times and channels are not decompressed before they are read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = Damage()
        self.channels: dict[int, Channel] = {}
        self._file = MappedFile(path)
        self._bytes = self._file.view
        self._blocks: list[Block] = []
        self._check_start()
        self._walk()
        self._index_unindexed()
        self._blocks = sorted((b for b in self._blocks if b.stamps), key=lambda block: block.start_ns)
        self._stamps = merge_stamps(self._blocks)

    @property
    def stamps(self) -> dict[int, NDArray[np.int64]]:
        """Receive times of all messages, per channel."""
        return self._stamps

    def read(self, channels: set[int]) -> Iterator[RawMessage]:
        """Messages of the channels in order of receive time; at most the chunks that overlap are in memory."""
        self._file.rewind()
        wanted = [block for block in self._blocks if not channels.isdisjoint(block.stamps)]
        return in_time_order((block.start_ns, partial(self._load, block, channels)) for block in wanted)

    def _check_start(self) -> None:
        """Raises InvalidInput when the file is of another kind."""
        raise NotImplementedError

    def _walk(self) -> None:
        """Fill `_blocks` and `channels`; note damage."""
        raise NotImplementedError

    def _records(self, data: memoryview, block: Block, channels: set[int] | None) -> Iterator[RawMessage]:
        """Messages in the data of one block; with `channels` None all of them, and declarations are taken in."""
        raise NotImplementedError

    def _lose(self, text: str, lost_bytes: int) -> None:
        self.damage.texts.append(text)
        self.damage.lost_bytes += lost_bytes

    def _index_unindexed(self) -> None:
        """Look inside chunks whose index is missing, or whose channels are declared only inside."""
        for block in self._blocks:
            known = all(channel in self.channels for channel in block.stamps)
            if block.loose or (known and block.stamps and not block.cut):
                continue
            stamps = StampLists()
            for message in self._messages(block, None):
                stamps.add(message.channel, message.receive_ns)
            if not block.stamps:
                block.stamps = stamps.arrays()
                block.start_ns = min(
                    (int(values.min()) for values in block.stamps.values()), default=block.start_ns
                )

    def _load(self, block: Block, channels: set[int]) -> list[RawMessage]:
        self._file.passed(block.begin)
        return [message for message in self._messages(block, channels) if message.channel in self.channels]

    def _messages(self, block: Block, channels: set[int] | None) -> Iterator[RawMessage]:
        try:
            yield from self._records(memoryview(self._open(block)), block, channels)
        except (DamageError, struct.error, ValueError, OverflowError) as error:
            text = f"a part of {(block.end - block.begin) / 1e6:.2g} MB at {block.begin / 1e6:.1f} MB is lost: {error}"
            if text not in self.damage.texts and not block.cut:
                self._lose(text, block.end - block.begin)

    def _open(self, block: Block) -> bytes | memoryview:
        data = self._bytes[block.begin : block.end]
        if block.loose:
            return data
        out = decompress(block.compression, data, block.size, cut=block.cut)
        if block.crc and not block.cut and zlib.crc32(out) != block.crc:
            raise DamageError("the checksum of the chunk is wrong")
        return out


class MappedFile:
    """A file's bytes without reading them; pages that were looked at are given back, so that memory stays flat."""

    def __init__(self, path: Path) -> None:
        self._map: mmap.mmap | None = None
        self._released = 0
        with path.open("rb") as stream:
            if path.stat().st_size:
                self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self.view = memoryview(self._map) if self._map is not None else memoryview(b"")

    def find(self, mark: bytes, start: int) -> int:
        """Where `mark` next occurs at or after `start`; -1 when it does not."""
        return -1 if self._map is None else self._map.find(mark, start)

    def passed(self, at: int) -> None:
        """What lies before `at` is not looked at soon; called often, acts every 32 MiB."""
        begin = 0 if at < self._released else self._released
        begin, end = _page(begin), _page(at)
        if self._map is not None and end - begin >= _RELEASE_BYTES and hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED, begin, end - begin)
            self._released = end

    def rewind(self) -> None:
        """Reading starts anew from the beginning."""
        if self._map is not None and hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED)
        self._released = 0


def _page(at: int) -> int:
    return at - at % mmap.PAGESIZE


def in_time_order(blocks: Iterable[tuple[int, Callable[[], list[RawMessage]]]]) -> Iterator[RawMessage]:
    """Messages of blocks (start time, loader) sorted by start, merged where blocks overlap.

    Only blocks that overlap in time are in memory together.
    """
    pending: list[RawMessage] = []
    for start_ns, load in blocks:
        cut = _first_at_or_after(pending, start_ns)
        yield from pending[:cut]
        pending = pending[cut:]
        pending.extend(load())
        pending.sort(key=_time)
    yield from pending


def _time(message: RawMessage) -> int:
    return message.receive_ns


def _first_at_or_after(pending: list[RawMessage], start_ns: int) -> int:
    for i, message in enumerate(pending):
        if message.receive_ns >= start_ns:
            return i
    return len(pending)


def merge_stamps(blocks: Iterable[Block]) -> dict[int, NDArray[np.int64]]:
    """Receive times per channel over all blocks, sorted."""
    parts: dict[int, list[NDArray[np.int64]]] = {}
    for block in blocks:
        for channel, stamps in block.stamps.items():
            parts.setdefault(channel, []).append(stamps)
    return {channel: np.sort(np.concatenate(arrays)) for channel, arrays in parts.items()}


@dataclass
class StampLists:
    """Collects receive times per channel while messages are walked."""

    lists: dict[int, list[int]] = field(default_factory=dict)

    def add(self, channel: int, stamp_ns: int) -> None:
        self.lists.setdefault(channel, []).append(stamp_ns)

    def arrays(self) -> dict[int, NDArray[np.int64]]:
        return {channel: np.array(values, np.int64) for channel, values in self.lists.items()}


class LooseRun:
    """A run of messages outside chunks, on its way to become a block."""

    LENGTH = 4096

    def __init__(self) -> None:
        self._begin = self._end = self._count = 0
        self._stamps = StampLists()

    @property
    def full(self) -> bool:
        return self._count >= self.LENGTH

    def add(self, channel: int, stamp_ns: int, begin: int, end: int) -> None:
        """A message whose record stands at `begin` to `end` of the file."""
        if not self._count:
            self._begin = begin
        self._stamps.add(channel, stamp_ns)
        self._end = end
        self._count += 1

    def take(self) -> list[Block]:
        """The run as a block, none when it is empty; a new run begins."""
        if not self._count:
            return []
        stamps = self._stamps.arrays()
        start_ns = min(int(values.min()) for values in stamps.values())
        block = Block(
            start_ns, self._begin, self._end, "", self._end - self._begin, loose=True, stamps=stamps
        )
        self._count, self._stamps = 0, StampLists()
        return [block]


def decompress(compression: str, data: memoryview, size: int, *, cut: bool = False) -> bytes | memoryview:
    """Bytes of a chunk. Never makes more than `size` bytes, whatever the compressed data claims.

    With `cut` the data may end early, and what can be had of it is returned.

    Raises
    ------
    DamageError : the declared size is not credible, the data is damaged, or of another size than declared.
    """
    if size > MAX_CHUNK_BYTES:
        raise DamageError(f"a chunk claims {size / 2**30:.1f} GiB, more than any recorder writes")
    if compression in ("", "none"):
        return data[:size]
    try:
        out = _INFLATE[compression](data, size)
    except KeyError:
        raise DamageError(f"a chunk is compressed by {compression!r}, which is unknown") from None
    except DamageError:
        raise
    except Exception as error:  # the three libraries have no common base
        raise DamageError(f"a chunk cannot be decompressed ({error})") from error
    if len(out) != size and not cut:
        raise DamageError(f"a chunk has {len(out)} bytes where {size} are declared")
    return out


def decompress_zstd(data: memoryview, size: int) -> bytes:
    """At most `size` bytes."""
    import zstandard

    reader = zstandard.ZstdDecompressor(max_window_size=1 << 30).stream_reader(data)
    return _bounded(reader.read, size)


def _lz4(data: memoryview, size: int) -> bytes:
    import lz4.frame

    machine = lz4.frame.LZ4FrameDecompressor()
    out: bytes = machine.decompress(data, max_length=size)
    return out


def _bz2(data: memoryview, size: int) -> bytes:
    return bz2.BZ2Decompressor().decompress(data, max_length=size)


def _bounded(read: Callable[[int], bytes], size: int) -> bytes:
    """Up to `size` bytes; what was had before the data ends or breaks is kept."""
    pieces: list[bytes] = []
    left = size
    while left > 0:
        piece = read(min(left, 1 << 24))
        if not piece:
            break
        pieces.append(piece)
        left -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


_INFLATE: dict[str, Callable[[memoryview, int], bytes]] = {"zstd": decompress_zstd, "lz4": _lz4, "bz2": _bz2}
