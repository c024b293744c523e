"""Imported by the process that local workers fork from, and by nothing else: workers start with what they will need.

Compiled kernels take about a second to load: one process does it for all workers, before it is asked for them.
Libraries that only late stages use are imported by each worker while it waits for work.
"""

from __future__ import annotations

import importlib
import os
import threading
import time

import scanloom.workflows.map_session  # noqa: F401  (all stages, and with them all kernels)
from scanloom.pipeline.task import at_work
from scanloom.stages.geometry.kernels import load_kernels

LATER = ("scipy.special", "gtsam", "scipy.spatial", "scipy.ndimage", "pyproj")
"""What fusion, evaluation and report import inside their functions, in the order of its use."""
PAUSE_S = 0.02


def import_while_idle() -> None:
    """Import `LATER` between tasks, one at a time; a task that begins waits for one import at most."""
    for name in LATER:
        while at_work():
            time.sleep(PAUSE_S)
        importlib.import_module(name)


def _on_the_side() -> None:
    threading.Thread(target=import_while_idle, name="imports", daemon=True).start()


load_kernels()
os.register_at_fork(after_in_child=_on_the_side)
