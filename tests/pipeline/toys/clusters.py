"""A cluster factory, as a user would write one."""

from __future__ import annotations

from typing import Any


def threads() -> Any:
    """One worker in this process that offers a GPU."""
    from distributed import LocalCluster

    return LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        dashboard_address="127.0.0.1:0",
        resources={"GPU": 1},
        silence_logs=50,
    )
