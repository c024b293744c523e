"""Imported by the process that local workers fork from, and by nothing else: every worker loads its kernels on the side.

A worker that waits for its first task, or for its disk, uses the time to load compiled code.
"""

from __future__ import annotations

import os
import threading

import scanloom.workflows.map_session  # noqa: F401  (all stages, and with them all kernels)
from scanloom.stages.geometry.kernels import load_kernels


def _load_on_the_side() -> None:
    threading.Thread(target=load_kernels, name="load kernels", daemon=True).start()


os.register_at_fork(after_in_child=_load_on_the_side)
