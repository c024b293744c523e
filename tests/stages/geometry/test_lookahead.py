"""Looking ahead and working in halves: same results, errors in their place, no thread left behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from scanloom.stages.geometry.halves import WORTH_IT, in_halves
from scanloom.stages.geometry.lookahead import ahead


def _failing(good: int) -> Iterator[int]:
    yield from range(good)
    raise ValueError("no more")


def test_items_keep_their_order() -> None:
    assert list(ahead(range(20))) == list(range(20))
    assert list(ahead([])) == []


def test_an_error_comes_where_its_item_would_have() -> None:
    items = ahead(_failing(3))
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="no more"):
        next(items)


def test_the_thread_ends_with_the_generator() -> None:
    items = ahead(range(20))
    next(items)
    items.close()  # type: ignore[attr-defined]
    assert not any(thread.name.startswith("ahead") for thread in threading.enumerate())


@pytest.mark.parametrize("rows", [0, 1, WORTH_IT - 1, WORTH_IT, 2 * WORTH_IT + 1])
def test_halves_cover_every_row_once(rows: int) -> None:
    seen = np.zeros(rows, int)

    def work(part: slice) -> None:
        seen[part] += 1

    in_halves(work, rows)
    assert (seen == 1).all()


def test_an_error_in_either_half_comes_out() -> None:
    def work(part: slice) -> None:
        if part.start:
            raise ValueError("second half")

    with pytest.raises(ValueError, match="second half"):
        in_halves(work, 2 * WORTH_IT)
