"""Where tasks run: in this process, on local processes, or on any Dask cluster."""

from __future__ import annotations

import importlib
import logging
import os
import queue
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Protocol

from scanloom.pipeline.forkserver import THREADS, start_forkserver
from scanloom.pipeline.task import Json, execute
from scanloom.schemas.errors import ScanloomError, UsageError

log = logging.getLogger(__name__)

CLOSED_WITHIN_S = 10.0
WORKERS_WITHIN_S = 60.0
"""How long to wait for the first worker of a cluster."""

Outcome = tuple[str, Json | BaseException]
"""Key of a task, and the worker's answer or the reason that there is none."""


class Executor(Protocol):
    """Carries out orders."""

    def slots(self) -> int:
        """Tasks that may be under way at once."""

    def submit(self, key: str, spec: Json, resources: Mapping[str, float]) -> None:
        """Start a task on a worker that offers these resources.

        Raises
        ------
        UsageError : no worker offers them.
        """

    def next(self, timeout_s: float) -> Outcome | None:
        """Wait for a task to end; None when none did in time."""

    def close(self) -> None:
        """Stop everything that is under way."""


def executor(cluster: str, workers: int | None, modules: Sequence[str] = ()) -> Executor:
    """The executor of `--cluster`: `none`, `local`, an address such as `tcp://host:8786`, or `module:factory`.

    Local workers start with `modules` imported.

    Raises
    ------
    UsageError : there is no such cluster, or it has no workers.
    """
    if workers is not None and workers < 1:
        raise UsageError(f"{workers} workers cannot do anything", next_step="give --workers a number from 1")
    if cluster == "none":
        return InProcess()
    if cluster == "local":
        return DaskExecutor(lambda: _local(workers, modules))
    if "://" in cluster:
        return DaskExecutor(lambda: _remote(cluster))
    if ":" in cluster:
        return DaskExecutor(lambda: _made(cluster, workers))
    raise UsageError(
        f"cluster {cluster!r} is unknown", next_step="choose none, local, tcp://host:port or module:factory"
    )


class InProcess:
    """One task at a time, in this process: for debugging and tests."""

    def __init__(self) -> None:
        self._waiting: list[tuple[str, Json]] = []

    def slots(self) -> int:
        return 1

    def submit(self, key: str, spec: Json, resources: Mapping[str, float]) -> None:
        if resources:
            raise _unmet(spec, resources)
        self._waiting.append((key, spec))

    def next(self, timeout_s: float) -> Outcome | None:
        key, spec = self._waiting.pop(0)
        return key, execute(spec)

    def close(self) -> None:
        self._waiting.clear()


class DaskExecutor:
    """Tasks on a Dask cluster; never more under way than it has threads, so that the driver keeps the order."""

    def __init__(self, connect: Callable[[], tuple[Any, Any]]) -> None:
        with _quiet():
            self._client, self._cluster = connect()
        self._done: queue.Queue[tuple[str, Any]] = queue.Queue()
        self._futures: dict[str, Any] = {}
        self._counted_at = 0.0
        self._threads = 0
        self._empty_since = time.monotonic()
        self._await_workers()

    def _await_workers(self) -> None:
        try:
            self._client.wait_for_workers(1, timeout=WORKERS_WITHIN_S)
        except TimeoutError as error:
            self.close()
            raise UsageError(
                f"the cluster has no worker after {WORKERS_WITHIN_S:.0f} s",
                next_step="start workers, or use --cluster local",
            ) from error

    def slots(self) -> int:
        if time.monotonic() - self._counted_at > 2.0 or not self._threads:
            self._threads = sum(self._client.nthreads().values())
            self._counted_at = time.monotonic()
        return max(self._threads, 1)

    def submit(self, key: str, spec: Json, resources: Mapping[str, float]) -> None:
        if resources and not self._offered(resources):
            raise _unmet(spec, resources)
        name = f"{spec['identity']['stage']}-{key}"
        future = self._client.submit(execute, spec, key=name, pure=False, resources=dict(resources) or None)
        self._futures[key] = future
        future.add_done_callback(lambda done, key=key: self._done.put((key, done)))

    def _offered(self, resources: Mapping[str, float]) -> bool:
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        return any(
            all(worker["resources"].get(name, 0) >= amount for name, amount in resources.items())
            for worker in workers
        )

    def next(self, timeout_s: float) -> Outcome | None:
        try:
            key, future = self._done.get(timeout=timeout_s)
        except queue.Empty:
            self._check_alive()
            return None
        self._futures.pop(key, None)
        if future.status == "finished":
            answer: Json = future.result()
            return key, answer
        self._check_alive()
        error = (
            future.exception() if future.status == "error" else RuntimeError(f"its task was {future.status}")
        )
        return key, error

    def _check_alive(self) -> None:
        """Fail rather than wait for ever on a cluster that is gone."""
        if self._client.status != "running":
            raise ScanloomError(
                "the connection to the cluster is lost",
                next_step="start it again and run the same command; what is done is kept",
            )
        if self._client.nthreads():
            self._empty_since = time.monotonic()
        elif time.monotonic() - self._empty_since > WORKERS_WITHIN_S:
            raise ScanloomError(
                f"the cluster has had no worker for {WORKERS_WITHIN_S:.0f} s",
                next_step="start workers and run the same command; what is done is kept",
            )

    def close(self) -> None:
        """A cluster that does not stop in time is left behind: what was made is in the store, and local processes end with
        this one."""
        with _quiet(), suppress(TimeoutError):
            for future in self._futures.values():
                future.cancel()
        for part in (self._client, self._cluster):
            if part is not None:
                with _quiet(), suppress(TimeoutError):
                    part.close(timeout=CLOSED_WITHIN_S)


def worker_death(error: BaseException) -> str:
    """In words, when the error says that workers died over a task; empty otherwise."""
    if type(error).__name__ != "KilledWorker":
        return ""
    return "the worker died twice over it (out of memory, or a crash in native code)"


def _local(workers: int | None, modules: Sequence[str]) -> tuple[Any, Any]:
    """Processes of this machine, one per core."""
    start_forkserver(modules)
    import dask
    from distributed import Client, LocalCluster

    dask.config.set(
        {
            "distributed.scheduler.allowed-failures": 1,
            "distributed.scheduler.work-stealing": False,
            "distributed.scheduler.worker-saturation": 1.0,
            "distributed.worker.multiprocessing-method": "forkserver",
            "distributed.worker.profile.enabled": False,  # it looks at every stack a hundred times a second
            "distributed.admin.system-monitor.interval": "10s",
            "distributed.nanny.preload": [],
            "distributed.nanny.environ": THREADS,
            "distributed.nanny.pre-spawn-environ": {},
            "distributed.admin.tick.limit": "1h",
            "distributed.comm.timeouts.connect": "60s",
        }
    )
    cluster = LocalCluster(
        n_workers=workers or os.cpu_count() or 1,
        threads_per_worker=1,
        processes=True,
        memory_limit=0,
        dashboard_address="127.0.0.1:0",
        worker_dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
        host="127.0.0.1",
    )
    return Client(cluster, set_as_default=False), cluster


def _remote(address: str) -> tuple[Any, Any]:
    from distributed import Client

    try:
        return Client(address, timeout=10, set_as_default=False), None
    except (OSError, TimeoutError, ValueError) as error:
        raise UsageError(
            f"no Dask scheduler answers: {error}",
            where=address,
            next_step="check the address, or use --cluster local",
        ) from error


def _made(path: str, workers: int | None) -> tuple[Any, Any]:
    """`module:factory` returns any Dask cluster object; it is asked for `workers` when it can scale."""
    from distributed import Client

    module, _, name = path.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"cluster factory cannot be imported: {error}", where=path) from error
    cluster = factory()
    if workers is not None and hasattr(cluster, "scale"):
        cluster.scale(workers)
    return Client(cluster, set_as_default=False), cluster


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask's own log is about its plumbing; errors reach the user by other ways."""
    import distributed  # noqa: F401  (importing it sets log levels, which are then changed)

    for name in (
        "distributed",
        "distributed.nanny",
        "distributed.worker",
        "distributed.scheduler",
        "tornado",
    ):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    yield


def unanswered(error: BaseException) -> ScanloomError:
    """The error of a task that gave no answer."""
    death = worker_death(error)
    if death:
        return ScanloomError(death, next_step="use fewer --workers, or --cluster none to see it happen")
    return ScanloomError(f"the cluster gave no answer: {error}", next_step="run the same command again")


def _unmet(spec: Json, resources: Mapping[str, float]) -> UsageError:
    asked = ", ".join(f"{name} {amount:g}" for name, amount in resources.items())
    return UsageError(
        f"no worker offers {asked}",
        where=spec["place"],
        next_step="start a worker with `dask worker --resources`, and name its scheduler with --cluster",
    )
