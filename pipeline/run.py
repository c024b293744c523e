"""Carry out a request: the loop that looks tasks up, sends them to workers and collects what became of them."""

from __future__ import annotations

import heapq
import itertools
import logging
from collections import defaultdict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from scanloom.pipeline.cluster import Executor, executor, unanswered
from scanloom.pipeline.flow import Flow, Task
from scanloom.pipeline.history import History
from scanloom.pipeline.identity import Identifier, Order
from scanloom.pipeline.memory import PeakMemory, now_s
from scanloom.pipeline.plan import plan
from scanloom.pipeline.progress import Progress, Silent
from scanloom.pipeline.records import RunRecord, forget_failure, record_failure
from scanloom.pipeline.request import Request
from scanloom.pipeline.store import Artifact, Store, part_coordinate, set_aside
from scanloom.pipeline.task import Json, describe_error, rebuild_error
from scanloom.pipeline.upkeep import clean
from scanloom.schemas.errors import InvalidInput, ScanloomError, StoreError
from scanloom.schemas.product import Coordinate, Parts, Product

__all__ = ["Result", "TaskRecord", "plan", "run"]

log = logging.getLogger(__name__)

POLL_S = 1.0

ProductT = TypeVar("ProductT", bound=Product)


@dataclass(frozen=True)
class TaskRecord:
    """What became of one task."""

    node: str
    coordinate: dict[str, str]
    key: str
    verdict: str
    """`RUN`, `HIT`, `FAILED` or `SKIPPED`."""
    reason: str
    wall_s: float = 0.0
    peak_rss_mb: float = 0.0
    error: ScanloomError | None = None


@dataclass(frozen=True)
class Result:
    """What became of a run."""

    tasks: list[TaskRecord]
    wall_s: float
    peak_rss_mb: float
    """Of all processes of the run together."""
    artifacts: list[tuple[Coordinate, Artifact]]

    @property
    def failures(self) -> list[TaskRecord]:
        return [task for task in self.tasks if task.verdict == "FAILED"]

    @property
    def skipped(self) -> list[TaskRecord]:
        return [task for task in self.tasks if task.verdict == "SKIPPED"]

    @property
    def executed(self) -> int:
        return sum(task.verdict == "RUN" for task in self.tasks)

    def parts(self, product: type[ProductT]) -> Parts[ProductT]:
        """Everything the run has of a product, with coordinates; opened when asked for."""
        return Parts(self.files(product), load=partial(_open, product))

    def files(self, product: type[Product]) -> list[tuple[Coordinate, Path]]:
        """Where each part of a product lies: a file, or a folder for `Files`."""
        return sorted(
            (part_coordinate(product, coordinate, part.key), artifact.path(part))
            for coordinate, artifact in self.artifacts
            for part in artifact.of(product)
        )


def _open(product: type[ProductT], path: Path) -> ProductT:
    return product.open(path)


def run(
    request: Request,
    store: Store,
    *,
    cluster: str = "local",
    workers: int | None = None,
    progress: Progress | None = None,
) -> Result:
    """Compute what is not in the store yet.

    A stage that fails takes its session out; the others go on. The cluster starts with the first task that must run.

    Raises
    ------
    UsageError : the workflow, the sessions, the settings or the cluster are wrong.
    StoreError : the store cannot be written; nothing is lost, the same command goes on from there.
    """
    started = now_s()
    with PeakMemory(children=True) as memory:
        driver = Driver(request, store, cluster, workers, progress or Silent())
        driver.drive()
    peak_mb = max(memory.peak_mb, driver.remote_peak_mb)
    return Result(driver.sorted_records(), now_s() - started, peak_mb, driver.artifacts)


class Driver:
    """One run, and the order of its tasks.

    Of those that are ready the deepest stage goes first, so that chunks flow through. Of these the biggest session
    goes first, and in it the biggest task.
    """

    def __init__(
        self, request: Request, store: Store, cluster: str, workers: int | None, progress: Progress
    ) -> None:
        self._flow = Flow(request)
        self._store = store
        self._cluster = cluster
        self._workers = workers
        self._progress = progress
        self._identifier = Identifier(self._flow, store)
        self._history = History(store)
        self._starting: Future[Executor] | None = None
        self._ready: list[tuple[tuple[int, int, int, Coordinate], int, Task, Order]] = []
        self._running: dict[str, tuple[Task, Order]] = {}
        self._twins: dict[str, list[Task]] = {}
        self._records: dict[Task, TaskRecord] = {}
        self._reasons: dict[str, str] = {}
        self._serial = itertools.count()
        self._peaks: dict[tuple[str, int], float] = {}
        self.artifacts: list[tuple[Coordinate, Artifact]] = []

    @property
    def remote_peak_mb(self) -> float:
        """Sum of the workers' own peaks, where they are out of sight of this machine."""
        return sum(self._peaks.values()) if "://" in self._cluster else 0.0

    def sorted_records(self) -> list[TaskRecord]:
        order = sorted(self._records, key=lambda task: (self._flow.depth[task.node.name], task.coordinate))
        return [self._records[task] for task in order]

    def drive(self) -> None:
        """Until nothing is ready and nothing runs."""
        clean(self._store)
        record = RunRecord.start(self._store)
        state = "failed"
        self._progress.begin([(node.name, node.title) for node in self._flow.nodes])
        try:
            if not self._identifier.knows_sources():
                self._start_executor()
            self._look_up()
            while self._ready or self._running:
                self._submit()
                self._identifier.foresee()
                self._collect()
                self._look_up()
            state = "finished"
        except KeyboardInterrupt:
            state = "interrupted"
            raise
        finally:
            self._stop_executor()
            self._progress.end()
            record.finish(state, [(r.node, r.coordinate, r.key, r.verdict) for r in self.sorted_records()])

    def _look_up(self) -> None:
        """Settle what the store has already; queue the rest."""
        while fresh := self._flow.take():
            for task in fresh:
                if task.state == "skipped":
                    self._record(task, "SKIPPED", task.reason)
                    continue
                try:
                    order = self._identifier.order(task, self._flow.inputs(task))
                except ScanloomError as error:
                    self._fail(task, "", describe_error(error, str(task)))
                    continue
                artifact = self._store.find(task.node.name, order.key)
                if artifact is not None:
                    self._done(task, artifact, "HIT", "already computed")
                else:
                    self._queue(task, order)
        self._show()

    def _queue(self, task: Task, order: Order) -> None:
        task.key = order.key
        if order.key in self._twins:
            self._twins[order.key].append(task)
            return
        self._twins[order.key] = []
        self._reasons[order.key] = self._history.reason(task, order.identity)
        sizes = (-self._identifier.session_bytes(task), -order.input_bytes)
        rank = (-self._flow.depth[task.node.name], *sizes, task.coordinate)
        heapq.heappush(self._ready, (rank, next(self._serial), task, order))

    def _start_executor(self) -> Future[Executor]:
        """On the side: a new log is hashed while the cluster starts."""
        if self._starting is None:
            modules = sorted({node.stage.__module__ for node in self._flow.nodes})
            side = ThreadPoolExecutor(1, "start executor")
            self._starting = side.submit(executor, self._cluster, self._workers, modules)
            side.shutdown(wait=False)
        return self._starting

    def _stop_executor(self) -> None:
        if self._starting is not None and self._starting.exception() is None:
            self._starting.result().close()

    def _submit(self) -> None:
        at_work = self._start_executor().result()
        while self._ready and len(self._running) < at_work.slots():
            *_, task, order = heapq.heappop(self._ready)
            self._running[order.key] = (task, order)
            at_work.submit(order.key, order.spec, dict(task.node.resources))
        self._show()

    def _collect(self) -> None:
        outcome = self._start_executor().result().next(POLL_S) if self._running else None
        if outcome is None:
            return
        key, answer = outcome
        task, order = self._running.pop(key)
        if isinstance(answer, BaseException):
            self._fail(task, key, describe_error(unanswered(answer), str(task)))
        elif answer["error"] is not None:
            self._fail(task, key, answer["error"], answer)
        elif changed := self._identifier.changed_sources(order.inputs):
            set_aside(self._store, self._store.folder(task.node.name, key))
            error = InvalidInput(
                "the file changed while it was read",
                where=", ".join(changed),
                next_step="wait until it is complete, then run the same command again",
            )
            self._fail(task, key, describe_error(error, str(task)), answer)
        else:
            self._computed(task, key, answer)

    def _computed(self, task: Task, key: str, answer: Json) -> None:
        self._peaks[answer["host"], answer["pid"]] = max(
            self._peaks.get((answer["host"], answer["pid"]), 0.0), answer["peak_rss_mb"]
        )
        artifact = self._store.find(task.node.name, key)
        if artifact is None:
            raise StoreError(
                f"{task} was computed but is not in the store",
                where=str(self._store.root),
                next_step="on a cluster the store must be a folder that all machines share",
            )
        self._done(task, artifact, "RUN", self._reasons[key], answer)
        for twin in self._twins.pop(key, []):
            self._done(twin, artifact, "HIT", "same as another task of this run")

    def _done(
        self, task: Task, artifact: Artifact, verdict: str, reason: str, answer: Json | None = None
    ) -> None:
        task.key = artifact.key
        self.artifacts.append((task.coordinate, artifact))
        self._record(task, verdict, reason, answer)
        forget_failure(self._store, str(task))
        self._flow.finish(task, artifact)

    def _fail(self, task: Task, key: str, body: Json, answer: Json | None = None) -> None:
        """One bad session does not stop the others; a store that cannot be written stops everything."""
        error = rebuild_error(body)
        kept = record_failure(self._store, str(task), error, body["trace"])
        if type(error) is ScanloomError and not error.next_step and kept is not None:
            error.next_step = f"this is a fault of the stage; the traceback is in {kept}"
        if isinstance(error, StoreError):
            raise error
        self._progress.note(f"{task.node.title} failed: {error}")
        for failed in [task, *self._twins.pop(key, [])]:
            self._record(failed, "FAILED", error.what, answer, error)
            self._flow.finish(failed, None)

    def _record(
        self,
        task: Task,
        verdict: str,
        reason: str,
        answer: Json | None = None,
        error: ScanloomError | None = None,
    ) -> None:
        wall_s, peak_mb = (answer["wall_s"], answer["peak_rss_mb"]) if answer else (0.0, 0.0)
        place = dict(task.coordinate)
        self._records[task] = TaskRecord(
            task.node.name, place, task.key, verdict, reason, wall_s, peak_mb, error
        )

    def _show(self) -> None:
        counts: dict[str, tuple[int, int, int]] = {}
        under_way: dict[str, int] = defaultdict(int)
        for task, _ in self._running.values():
            under_way[task.node.name] += 1
        for node in self._flow.nodes:
            tasks = [task for _, group in self._flow.groups(node) for task in group.tasks.values()]
            known = sum(task.state != "skipped" for task in tasks)
            pending = sum(group.open for _, group in self._flow.groups(node))
            counts[node.name] = (known - pending, under_way[node.name], known)
        self._progress.update(counts)
