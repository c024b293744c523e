"""The small simulated session, mapped once per test run and shared by every test that needs a whole map."""

from __future__ import annotations

import fcntl
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from scanloom.pipeline.run import Result, run
from scanloom.pipeline.store import Store
from scanloom.workflows.build_map import Order, request_of

SMALL = {
    "simulate": {
        "size": "small",
        "cameras": 1,
        "camera_width_px": 160,
        "camera_height_px": 100,
        "camera_rate_hz": 1.0,
    }
}
"""With a camera, so that every stage has something to do."""


@dataclass(frozen=True)
class Mapped:
    """A finished run in a store of its own."""

    result: Result
    store: Store


def order(folder: Path, cluster: str = "none") -> Order:
    """The small sample, to be mapped below `folder`."""
    return Order(
        sessions=("sample",), out=folder / "out", name="sample", store=folder / "store", cluster=cluster,
        command_line=SMALL,
    )  # fmt: skip


def map_small(folder: Path, cluster: str = "none", workers: int | None = None) -> Mapped:
    """Run every stage on the small sample."""
    request, errors = request_of(order(folder, cluster))
    assert not errors
    store = Store(folder / "store")
    result = run(request, store, cluster=cluster, workers=workers)
    assert not result.failures, [str(t.error) for t in result.failures]
    return Mapped(result, store)


def track_in_windows(
    mapped: Mapped, folder: Path, cluster: str = "none", workers: int | None = None, *, windows: int = 3
) -> Mapped:
    """What was mapped, once more as far as odometry and in windows, in a copy of the store."""
    settings = SMALL | {"odometry": {"windows": windows, "window_overlap_s": 1.0}}
    request, errors = request_of(replace(order(folder, cluster), command_line=settings))
    assert not errors
    last = next(i for i, n in enumerate(request.nodes) if n.name == "odometry")
    store = copy_store(mapped, folder)
    result = run(replace(request, nodes=request.nodes[: last + 1]), store, cluster=cluster, workers=workers)
    assert not result.failures, [str(t.error) for t in result.failures]
    return Mapped(result, store)


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    """The small sample mapped in this process; made once even when tests run side by side."""
    shared = (
        tmp_path_factory.getbasetemp().parent
        if os.environ.get("PYTEST_XDIST_WORKER")
        else tmp_path_factory.getbasetemp()
    )
    folder = shared / "small-sample"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return map_small(folder)


def copy_store(mapped: Mapped, folder: Path) -> Store:
    """A store with the same content that a test may damage."""
    shutil.copytree(mapped.store.root, folder / "store")
    return Store(folder / "store")
