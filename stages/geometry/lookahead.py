"""Preparing the next item while the current one is worked on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

ItemT = TypeVar("ItemT")
_END: Any = object()


def ahead(items: Iterable[ItemT]) -> Iterator[ItemT]:
    """The same items in the same order; a thread makes the next one while the caller has the current one.

    It pays where items are made by what runs without the GIL: kernels, Parquet. An error comes out where its item would
    have. The thread ends with the generator, also when that is closed early.
    """
    iterator = iter(items)
    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as helper:
        coming = helper.submit(next, iterator, _END)
        while (item := coming.result()) is not _END:
            coming = helper.submit(next, iterator, _END)
            yield item
