"""Files that rosbag2 compressed as a whole (`.mcap.zstd`, `.db3.zstd`), unpacked to a temporary file."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.logs.containers import Channel, Container, RawMessage
from scanloom.stages.logs.records import Damage

_MAX_RATIO = 250
"""Real logs shrink to a fifth at best; what unpacks to more than this is a bomb."""
_STEP = 1 << 22


class PackedFile:
    """A container inside a zstd file. The temporary file lives as long as this object."""

    def __init__(self, path: Path, inner: Callable[[Path], Container]) -> None:
        self.path = path
        self._folder = tempfile.TemporaryDirectory(prefix="scanloom-")
        plain = Path(self._folder.name) / path.name.removesuffix(".zstd")
        self._own = Damage()
        cut = _unpack(path, plain)
        if cut:
            self._own.texts.append(f"the compressed file ends early or is damaged ({cut})")
        try:
            self._inner = inner(plain)
        except InvalidInput as error:
            what = f"The compressed file is damaged or was cut too early ({cut})." if cut else error.what
            raise InvalidInput(what, where=str(path), next_step=error.next_step) from error

    @property
    def channels(self) -> dict[int, Channel]:
        return self._inner.channels

    @property
    def stamps(self) -> dict[int, NDArray[np.int64]]:
        return self._inner.stamps

    @property
    def damage(self) -> Damage:
        inner = self._inner.damage
        return Damage([*self._own.texts, *inner.texts], self._own.lost_bytes + inner.lost_bytes)

    def read(self, channels: set[int]) -> Iterator[RawMessage]:
        return self._inner.read(channels)


def _unpack(source: Path, target: Path) -> str:
    """Unpack as far as possible; return why it ended early, empty when it did not."""
    import zstandard

    limit = _MAX_RATIO * source.stat().st_size + (1 << 20)
    written = 0
    with source.open("rb") as packed, target.open("wb") as plain:
        reader = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(
            packed, read_across_frames=True
        )
        try:
            while piece := reader.read(_STEP):
                written += len(piece)
                if written > limit:
                    raise InvalidInput(
                        f"The file unpacks to more than {_MAX_RATIO} times its size; no log does.",
                        where=str(source),
                        next_step="unpack it yourself with `zstd -d` if you trust it",
                    )
                plain.write(piece)
        except zstandard.ZstdError as error:
            return str(error)
    if not written:
        return "it ends before its first block does"
    return "" if _complete(source, written) else "it is shorter than it says"


def _complete(source: Path, written: int) -> bool:
    """Whether as much came out as the frame's header promises; True when it promises nothing."""
    import zstandard

    with source.open("rb") as packed:
        try:
            promised = zstandard.get_frame_parameters(packed.read(32)).content_size
        except zstandard.ZstdError:
            return False
    return promised in (0, zstandard.CONTENTSIZE_UNKNOWN) or written >= promised
