"""How much memory a run takes: resident size of processes, sampled."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

import psutil

PERIOD_S = 0.2
CHILDREN_EVERY = 5
"""Samples between two looks for new child processes; looking walks all processes of the machine."""


class PeakMemory:
    """Highest resident size, MB, seen between entering and leaving; with `children`, of all of them together."""

    def __init__(self, *, children: bool = False) -> None:
        self._children = children
        self._processes = {psutil.Process().pid: psutil.Process()}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="peak memory", daemon=True)
        self.peak_mb = 0.0

    def __enter__(self) -> Self:
        self._sample()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._sample()

    def _watch(self) -> None:
        count = 0
        while not self._stop.wait(PERIOD_S):
            if self._children and count % CHILDREN_EVERY == 0:
                self._find_children()
            count += 1
            self._sample()

    def _find_children(self) -> None:
        try:
            for child in psutil.Process().children(recursive=True):
                self._processes.setdefault(child.pid, child)
        except psutil.Error:
            pass

    def _sample(self) -> None:
        total = 0
        for pid, process in list(self._processes.items()):
            try:
                total += process.memory_info().rss
            except psutil.Error:
                del self._processes[pid]
        self.peak_mb = max(self.peak_mb, total / 1e6)


def now_s() -> float:
    """A clock for durations."""
    return time.perf_counter()
