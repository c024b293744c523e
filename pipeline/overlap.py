"""Reading ahead and writing behind: one helper thread each, so that disk and compression overlap with computing.

What is computed, and its order, are the same as without.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from scanloom.schemas.product import Stream

DEPTH = 1
"""Items that may wait between the two threads; 0 switches the helper threads off."""

T = TypeVar("T")
_END = object()


class _StoppedError(Exception):
    """The other side has gone."""


class _Pipe:
    """A bounded queue whose two ends notice when the other one is gone."""

    def __init__(self, depth: int) -> None:
        self._items: queue.Queue[Any] = queue.Queue(depth)
        self._stopped = threading.Event()

    def stop(self) -> None:
        self._stopped.set()

    def put(self, item: Any) -> None:
        while not self._stopped.is_set():
            try:
                self._items.put(item, timeout=0.1)
            except queue.Full:
                continue
            return
        raise _StoppedError

    def get(self) -> Any:
        while True:
            try:
                return self._items.get(timeout=0.1)
            except queue.Empty:
                if self._stopped.is_set():
                    raise _StoppedError from None


def read_ahead(items: Iterator[T]) -> Iterator[T]:
    """The same items; a thread has the next one ready. Errors come out where the item would have."""
    return _ahead(items) if DEPTH else items


def _ahead(items: Iterator[T]) -> Iterator[T]:
    pipe = _Pipe(DEPTH)

    def fill() -> None:
        try:
            try:
                for item in items:
                    pipe.put((item, None))
                pipe.put((_END, None))
            except _StoppedError:
                pass
            except BaseException as error:
                pipe.put((_END, error))
        except _StoppedError:
            pass

    thread = threading.Thread(target=fill, name="read ahead", daemon=True)
    thread.start()
    try:
        while True:
            item, error = pipe.get()
            if error is not None:
                raise error
            if item is _END:
                return
            yield item
    finally:
        pipe.stop()
        thread.join()


def write_behind(stream: Stream[Any], write: Callable[[Stream[Any]], T]) -> T:
    """`write(stream)` on a helper thread, while this one computes the items."""
    if not DEPTH:
        return write(stream)
    pipe = _Pipe(DEPTH)
    with ThreadPoolExecutor(1, thread_name_prefix="write behind") as pool:
        written: Future[T] = pool.submit(_consume, pipe, type(stream), write)
        try:
            for item in stream:
                pipe.put(item)
            pipe.put(_END)
        except _StoppedError:
            pass
        except BaseException:
            pipe.stop()
            raise
        return written.result()


def _consume(pipe: _Pipe, kind: type[Stream[Any]], write: Callable[[Stream[Any]], T]) -> T:
    def items() -> Iterator[Any]:
        while (item := pipe.get()) is not _END:
            yield item

    try:
        return write(kind(items()))
    finally:
        pipe.stop()
