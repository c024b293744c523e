"""Imported by the process that local workers fork from, and by nothing else: workers start with what they will need.

What every task needs is loaded once for all workers. The rest is loaded by each worker while it waits for work:
compiled kernels, and libraries that only late stages use.
"""

from __future__ import annotations

import importlib
import os
import sys
import threading
import time
from collections.abc import Iterator

import scanloom.workflows.map_session  # noqa: F401  (all stages, and with them all kernels)
from scanloom.pipeline.task import at_work
from scanloom.stages.geometry.kernels import load_kernels

LATER = ("scipy.special", "gtsam", "scipy.spatial", "scipy.ndimage", "pyproj")
"""What fusion, evaluation and report import inside their functions, in the order they are used."""
PAUSE_S = 0.02
LOWEST_PRIORITY = 19


def _first_kernel(kernels: Iterator[None]) -> None:
    """Sets numba up. It would import scipy.linalg only to see whether BLAS is there, for a fifth of a second on which every
    run waits; no kernel multiplies matrices with it."""
    if "scipy.linalg" in sys.modules:
        next(kernels, None)
        return
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]  # importing it fails until this is undone
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules["scipy.linalg"]
    next(kernels, None)


_kernels = load_kernels()


def load_while_idle() -> None:
    """Between tasks, one thing at a time: a task that begins waits for one of them at most. Other workers go first."""
    if sys.platform == "linux":  # nowhere else have threads a priority of their own
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST_PRIORITY)
    for _ in _kernels:
        _wait()
    for name in LATER:
        _wait()
        importlib.import_module(name)


def _wait() -> None:
    while at_work():
        time.sleep(PAUSE_S)


def _on_the_side() -> None:
    threading.Thread(target=load_while_idle, name="loading", daemon=True).start()


_first_kernel(_kernels)
os.register_at_fork(after_in_child=_on_the_side)
