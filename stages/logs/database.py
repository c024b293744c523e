"""The sqlite3 storage of rosbag2 (`.db3`), whole or damaged.

Only what every version has is used: the tables `topics` and `messages`. Source: rosbag2_storage_sqlite3.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.logs.containers import MAX_MESSAGE_BYTES, Channel, RawMessage, StampLists
from scanloom.stages.logs.records import Damage

MAGIC = b"SQLite format 3\0"
_LONGEST_STRIDE = 1024
_GIVE_UP_AFTER = 2000


class DatabaseFile:
    """One .db3 file; the list of messages is read when it is opened, their bytes one by one later."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = Damage()
        self.channels: dict[int, Channel] = {}
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        self._rows = np.empty((0, 3), np.int64)
        if path.stat().st_size < 100 or not _begins(path, MAGIC):
            raise self._no_bag("This is no rosbag2 database: its first bytes are not those of SQLite.")
        try:
            self._base = self._connect()
            self._channels()
        except sqlite3.Error as error:
            raise self._no_bag(
                f"The database holds no rosbag2 log, or its beginning is damaged ({error})."
            ) from error
        self._list()

    @property
    def stamps(self) -> dict[int, NDArray[np.int64]]:
        """Receive times of all messages, per channel, sorted."""
        lists = StampLists()
        for _, channel, stamp in self._rows.tolist():
            lists.add(channel, stamp)
        return lists.arrays()

    def read(self, channels: set[int]) -> Iterator[RawMessage]:
        """Messages of the channels in order of receive time. Rows that cannot be read are counted as lost."""
        lost = 0
        for row, channel, stamp in self._rows[np.isin(self._rows[:, 1], list(channels))].tolist():
            try:
                found = self._base.execute("SELECT data FROM messages WHERE rowid=?", (row,)).fetchone()
            except (sqlite3.Error, MemoryError, OverflowError):
                found = None
            data = found[0] if found else None
            if isinstance(data, bytes) and len(data) <= MAX_MESSAGE_BYTES:
                yield RawMessage(stamp, channel, memoryview(data))
            else:
                lost += 1
        if lost:
            self.damage.texts.append(f"{lost} messages of the database cannot be read")

    def _connect(self) -> sqlite3.Connection:
        wal = self.path.with_name(self.path.name + "-wal")
        path, mode = self.path, "mode=ro&immutable=1"
        if wal.is_file() and wal.stat().st_size:
            # the recorder died: its last messages are in the log beside the database; merging them writes
            path, mode = self._copy(self.path.stat().st_size), "mode=rw"
            shutil.copyfile(wal, path.with_name(path.name + "-wal"))
        elif beyond := self.path.stat().st_size % _page_bytes(self.path):
            # SQLite takes a page that is cut for one that ends in zeros, and a cloud with it
            path = self._copy(self.path.stat().st_size - beyond)
        base = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True, check_same_thread=False)
        # a file shorter than its header says is refused otherwise
        base.execute("PRAGMA writable_schema=ON")
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        base.text_factory = lambda raw: raw.decode("utf-8", "replace")
        return base

    def _copy(self, size: int) -> Path:
        """The first `size` bytes as a temporary file that lives as long as this object."""
        self._scratch = tempfile.TemporaryDirectory(prefix="scanloom-")
        path = Path(self._scratch.name) / "log.db3"
        with self.path.open("rb") as source, path.open("wb") as target:
            shutil.copyfileobj(source, target, 1 << 22)
            target.truncate(size)
        return path

    def _channels(self) -> None:
        rows = self._base.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        for number, name, kind, encoding in rows:
            self.channels[int(number)] = Channel(str(name), str(kind), str(encoding))

    def _list(self) -> None:
        """(row, channel, time) of every message that can be listed, in order of time."""
        rows: list[tuple[int, int, int]] = []
        position, stride, failures, first_error = -1, 1, 0, ""
        while failures < _GIVE_UP_AFTER:
            try:
                query = "SELECT rowid, topic_id, timestamp FROM messages WHERE rowid > ? ORDER BY rowid"
                for row, channel, stamp in self._base.execute(query, (position,)):
                    if isinstance(channel, int) and isinstance(stamp, int) and channel in self.channels:
                        rows.append((row, channel, stamp))
                    position, stride = row, 1
                break
            except (sqlite3.Error, OverflowError) as error:
                first_error = first_error or str(error)
                failures += 1
                position += stride
                stride = min(2 * stride, _LONGEST_STRIDE)
        if first_error:
            self._note_list_damage(first_error)
        table = np.array(rows, np.int64).reshape(-1, 3)
        self._rows = table[np.argsort(table[:, 2], kind="stable")]

    def _note_list_damage(self, error: str) -> None:
        size = self.path.stat().st_size
        with self.path.open("rb") as stream:
            declared = _page_bytes(self.path) * int.from_bytes(stream.read(32)[28:32], "big")
        lost = max(declared - size, 0)
        share = f"; {100 * lost / declared:.0f} % of the file is missing" if lost else ""
        self.damage.texts.append(f"the database is damaged ({error}){share}")
        self.damage.lost_bytes += lost

    def _no_bag(self, what: str) -> InvalidInput:
        return InvalidInput(
            what,
            where=str(self.path),
            next_step="copy the log again from where it was recorded, or give another one",
        )


def _begins(path: Path, magic: bytes) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(magic)) == magic


def _page_bytes(path: Path) -> int:
    """Page size from the header of the database (SQLite file format, section 1.3.2)."""
    with path.open("rb") as stream:
        page = int.from_bytes(stream.read(18)[16:18], "big")
    return 65536 if page == 1 else max(page, 512)
