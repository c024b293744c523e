"""Imported by the process that local workers fork from, and by nothing else: all workers share the kernels it loads.

Loading takes about a second of computing, which one process pays before it is asked for workers, instead of each of them while it works.
"""

from __future__ import annotations

import scanloom.workflows.map_session  # noqa: F401  (all stages, and with them all kernels)
from scanloom.stages.geometry.kernels import load_kernels

load_kernels()
