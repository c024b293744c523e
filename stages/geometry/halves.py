"""Work on many independent rows, done by two threads at once."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

WORTH_IT = 1200
"""Rows from which on the second thread is asked: below, waking it takes longer than the work."""

_helper = ThreadPoolExecutor(1, thread_name_prefix="second half")


def in_halves(work: Callable[[slice], None], rows: int) -> None:
    """Call `work` for the two halves of `rows`, on two threads; it must release the GIL and touch only its own rows.

    The outcome is that of one call for all rows. Odometry goes through a session scan by scan and so leaves a second
    core idle; where there is none, two halves in turn take as long as the whole.
    """
    if rows < WORTH_IT:
        work(slice(0, rows))
        return
    second = _helper.submit(work, slice(rows // 2, rows))
    try:
        work(slice(0, rows // 2))
    finally:
        second.result()
