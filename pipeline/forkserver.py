"""The process that local workers fork from: started once, with everything imported that they need.

Its imports take more than a second, on another core; a command line starts it before its own imports. Imports nothing heavy.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

THREADS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "ARROW_NUM_THREADS": "1",
}
"""Environment of local workers: one native thread each.

Dask's MALLOC_TRIM_THRESHOLD_ is left out: giving every freed cloud back to the system made deskew take half as long again.
"""


def start_forkserver(modules: Sequence[str]) -> None:
    """Start the process unless it runs; it imports `modules` while this process goes on."""
    from multiprocessing import forkserver, get_context

    for name, value in THREADS.items():
        os.environ.setdefault(name, value)
    ours = [
        "scanloom.pipeline.local_worker",
        "distributed",
        "scanloom.pipeline.task",
        "pyarrow.compute",
        "pyarrow.parquet",
        "numpy.random",
    ]
    get_context("forkserver").set_forkserver_preload([*ours, *modules])
    forkserver.ensure_running()
