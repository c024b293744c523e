"""A COPC 1.0 file: LAZ with a chunk per node, an info record in front and the hierarchy behind.

Chunks are compressed by lazrs, many at a time; the layout is that of the specification (copc.io, version 1.0).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.las_points import SCALE_M, Records, Rows, las_header, places_of
from scanloom.stages.exports.octree import CELLS, Key, Octree

ENTRY = np.dtype(
    [
        ("level", "<i4"), ("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("offset", "<u8"), ("bytes", "<i4"), ("points", "<i4")
    ]
)  # fmt: skip
PAGE_DEPTH = 5
"""The hierarchy is cut into pages of so many depths: a reader fetches a few kilobytes at a time."""
ANOTHER_PAGE = -1
AT_ONCE_BYTES = 1 << 25
"""Nodes are gathered to so much before they are compressed, so that all cores have work."""
_INFO = struct.Struct("<5d2Q2d88x")
_EVLR = struct.Struct("<H16sHQ32s")
_BEFORE_CHUNKS = 8
"""Bytes between the header and the first chunk: where the table of chunks lies."""


class CopcFile:
    """Nodes in, in any order; each once."""

    def __init__(self, path: Path, projector: Projector, records: Records, octree: Octree) -> None:
        import laspy
        import lazrs

        self._octree, self._records = octree, records
        self._vlr = lazrs.LazVlr.new_for_compression(
            *(records.point_format, records.extra_bytes), use_variable_size_chunks=True
        )
        self._header = las_header(projector, records)
        self._header.are_points_compressed = True
        self._info = laspy.VLR("copc", 1, "COPC info VLR", b"\0" * _INFO.size)
        self._header.vlrs.insert(0, self._info)
        self._header.vlrs.append(laspy.vlrs.known.LasZipVlr(self._vlr.record_data()))
        self._stream: IO[bytes] = path.open("w+b")
        self._header.write_to(self._stream)
        self._start = self._stream.tell()
        self._compressor = lazrs.ParLasZipCompressor(self._stream, self._vlr)
        self._compressor.reserve_offset_to_chunk_table()
        self._waiting: list[Any] = []
        self._keys: list[Key] = []
        self._points: list[int] = []
        self._summary = _Summary()

    def node(self, key: Key, rows: Rows) -> None:
        """Add the points (n,) of one node, n > 0."""
        self._keys.append(key)
        self._points.append(len(rows))
        self._summary.add(rows)
        self._waiting.append(np.ascontiguousarray(rows).view(np.uint8))
        if sum(map(len, self._waiting)) > AT_ONCE_BYTES:
            self._compress()

    def close(self) -> None:
        """Write what is missing: table of chunks, hierarchy, and the header once more."""
        self._compress()
        self._compressor.done()
        self._stream.seek(0, 2)
        evlr_at = self._stream.tell()
        root_bytes = self._write_hierarchy(evlr_at)
        self._finish_header(evlr_at, root_bytes)
        self._stream.close()

    def _compress(self) -> None:
        if self._waiting:
            self._compressor.compress_chunks(self._waiting)
            self._waiting = []

    def _entries(self) -> NDArray[np.void]:
        """One row per node, its place from the table of chunks."""
        import lazrs

        self._stream.seek(self._start)
        sizes = np.array([size for _, size in lazrs.read_chunk_table(self._stream, self._vlr)], np.int64)
        out = np.zeros(len(self._keys), ENTRY)
        for axis, name in enumerate(("level", "x", "y", "z")):
            out[name] = [key[axis] for key in self._keys]
        out["offset"] = self._start + _BEFORE_CHUNKS + np.cumsum(sizes) - sizes
        out["bytes"], out["points"] = sizes, self._points
        return out

    def _write_hierarchy(self, evlr_at: int) -> int:
        """Pages as one extended record, the root's first; returns the root's length, bytes."""
        pages = pages_of(self._entries(), evlr_at + _EVLR.size)
        payload = b"".join(page.tobytes() for page in pages)
        self._stream.seek(evlr_at)
        self._stream.write(_EVLR.pack(0, b"copc", 1000, len(payload), b"COPC hierarchy"))
        self._stream.write(payload)
        return pages[0].nbytes

    def _finish_header(self, evlr_at: int, root_bytes: int) -> None:
        header, summary = self._header, self._summary
        centre = self._octree.corner * SCALE_M + self._records.offset_m
        half = self._octree.edge(self._octree.top) * SCALE_M / 2.0
        self._info.record_data = _INFO.pack(
            *(centre + half), half, 2.0 * half / CELLS, evlr_at + _EVLR.size, root_bytes, *summary.gps_times
        )
        points = sum(self._points)
        header.point_count = points
        header.number_of_points_by_return = np.array([points] + [0] * 14, np.uint64)
        header.mins = summary.low * SCALE_M + self._records.offset_m
        header.maxs = summary.high * SCALE_M + self._records.offset_m
        header.start_of_first_evlr, header.number_of_evlrs = evlr_at, 1
        self._stream.seek(0)
        header.write_to(self._stream, ensure_same_size=True)


class _Summary:
    """Bounds and times of all points."""

    def __init__(self) -> None:
        self._low, self._high = np.full(3, np.iinfo(np.int64).max), np.full(3, np.iinfo(np.int64).min)
        self._first_s, self._last_s = np.inf, -np.inf

    def add(self, rows: Rows) -> None:
        places = places_of(rows)
        self._low = np.minimum(self._low, places.min(axis=0))
        self._high = np.maximum(self._high, places.max(axis=0))
        self._first_s = min(self._first_s, float(rows["gps_time"].min()))
        self._last_s = max(self._last_s, float(rows["gps_time"].max()))

    @property
    def _empty(self) -> bool:
        return not np.isfinite(self._first_s)

    @property
    def low(self) -> NDArray[np.int64]:
        return np.zeros(3, np.int64) if self._empty else self._low

    @property
    def high(self) -> NDArray[np.int64]:
        return np.zeros(3, np.int64) if self._empty else self._high

    @property
    def gps_times(self) -> tuple[float, float]:
        return (0.0, 0.0) if self._empty else (self._first_s, self._last_s)


def page_of(entries: NDArray[np.void]) -> NDArray[np.int64]:
    """Key (n, 4) of the page that lists each node: its ancestor at a depth that is a multiple of `PAGE_DEPTH`."""
    up = entries["level"] % PAGE_DEPTH
    columns = (entries["level"] - up, *(entries[name] >> up for name in "xyz"))
    return np.column_stack(columns).astype(np.int64)


def pages_of(entries: NDArray[np.void], start: int) -> list[NDArray[np.void]]:
    """Pages of the hierarchy, laid out one after another from an offset of the file; the root's is the first.

    Every node stands in one page; the node that heads a page also stands in the page above, as a pointer to it.
    """
    keys, page = np.unique(page_of(entries), axis=0, return_inverse=True)
    page = page.reshape(-1)
    if len(keys) == 0:
        return [np.zeros(0, ENTRY)]
    pointers = np.zeros(len(keys) - 1, ENTRY)
    for axis, name in enumerate(("level", "x", "y", "z")):
        pointers[name] = keys[1:, axis]
    pointers["points"] = ANOTHER_PAGE
    above = pointers.copy()
    for name in "xyz":
        above[name] >>= PAGE_DEPTH
    above["level"] -= PAGE_DEPTH
    numbers = {tuple(key): number for number, key in enumerate(keys.tolist())}
    listed_in = np.array([numbers[tuple(key)] for key in page_of(above).tolist()], np.int64)
    lengths = np.bincount(page, minlength=len(keys)) + np.bincount(listed_in, minlength=len(keys))
    offsets = start + (np.cumsum(lengths) - lengths) * ENTRY.itemsize
    pointers["offset"], pointers["bytes"] = offsets[1:], lengths[1:] * ENTRY.itemsize
    everything, where = np.concatenate((entries, pointers)), np.concatenate((page, listed_in))
    order = np.argsort(where, kind="stable")
    return np.split(everything[order], np.cumsum(lengths)[:-1])
