"""Reading ahead and writing behind: same items, same order, errors where they belong."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from scanloom.pipeline import overlap
from scanloom.pipeline.overlap import read_ahead, write_behind
from tests.pipeline.toys.products import Numbers, Smooth


def numbers(count: int):
    return [Numbers(value=np.arange(i, dtype=np.int64), index=i) for i in range(count)]


def drain(stream: Smooth) -> int:
    return sum(1 for _ in stream)


def test_read_ahead_gives_the_same_items():
    assert list(read_ahead(iter(range(50)))) == list(range(50))


def test_read_ahead_is_one_step_ahead_and_no_more():
    taken = []

    def source():
        for i in range(10):
            taken.append(i)
            yield i

    items = read_ahead(source())
    next(items)
    time.sleep(0.1)
    assert len(taken) <= 2 + overlap.DEPTH
    items.close()


def test_read_ahead_raises_where_the_item_would_be():
    def source():
        yield 1
        raise ValueError("bad")

    items = read_ahead(source())
    assert next(items) == 1
    with pytest.raises(ValueError, match="bad"):
        next(items)


def test_threads_end_when_the_reader_leaves_early():
    before = threading.active_count()
    items = read_ahead(iter(range(1000)))
    next(items)
    items.close()
    assert threading.active_count() == before


def test_write_behind_writes_the_same_bytes(tmp_path, monkeypatch):
    def write(name):
        return write_behind(Smooth(iter(numbers(5))), lambda stream: stream.write(tmp_path / name))

    assert write("behind") == 5
    monkeypatch.setattr(overlap, "DEPTH", 0)
    assert write("directly") == 5
    assert (tmp_path / "behind").read_bytes() == (tmp_path / "directly").read_bytes()
    again = Smooth.open(tmp_path / "behind", read_ahead)
    assert [item.index for item in again] == list(range(5))
    assert again[3].value.tolist() == [0, 1, 2]


def test_write_behind_computes_on_the_calling_thread():
    threads = []

    def items():
        threads.append(threading.current_thread())
        yield from numbers(2)

    write_behind(Smooth(items()), drain)
    assert threads == [threading.current_thread()]


def test_write_behind_passes_errors_of_both_sides():
    def broken():
        yield numbers(1)[0]
        raise KeyError("stage")

    with pytest.raises(KeyError, match="stage"):
        write_behind(Smooth(broken()), drain)

    def full(stream):
        next(iter(stream))
        raise OSError("disk")

    with pytest.raises(OSError, match="disk"):
        write_behind(Smooth(iter(numbers(100))), full)
