"""One map from start to finish: find the logs, run the stages, deliver the folder."""

from __future__ import annotations

import dataclasses
import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from scanloom.pipeline.plan import PlannedTask, Request
from scanloom.pipeline.plan import plan as plan_tasks
from scanloom.pipeline.progress import Progress
from scanloom.pipeline.run import Result, run
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import EXIT_INTERNAL, EXIT_OK, EXIT_SOME_FAILED, ScanloomError, StageError
from scanloom.schemas.evaluation import Metrics, ReportFiles
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import TileIndex
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.report.page import compose
from scanloom.stages.report.run import run_section
from scanloom.workflows.configuration import Overrides, merged
from scanloom.workflows.delivery import Label, Metric, change_rows, claim, deliver, metric_rows, write_text
from scanloom.workflows.map_session import NODES
from scanloom.workflows.parent import Parent, altered_tiles, check_logs, check_new
from scanloom.workflows.run_part import run_of
from scanloom.workflows.sessions import Sought, find_sessions
from scanloom.workflows.sources import log_digests, write_sources

METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"


@dataclass(frozen=True)
class Order:
    """What is to be mapped, where to, and how."""

    sessions: tuple[str, ...]
    out: Path
    name: str
    store: Path
    cluster: str = "local"
    workers: int | None = None
    project: Overrides = field(default_factory=dict)
    command_line: Overrides = field(default_factory=dict)
    started_s: float = field(default_factory=time.time)
    parent: Parent | None = None
    """The map that is extended."""

    @property
    def settings(self) -> Overrides:
        """Of all layers but the sessions' own."""
        before = self.parent.settings if self.parent else {}
        return merged(before, self.project, self.command_line)


@dataclass(frozen=True)
class Outcome:
    """What came of it: the folder, its figures, and what failed."""

    out: Path
    exit_code: int
    delivered: bool
    metrics: list[Metric]
    executed: int
    failures: list[tuple[str, ScanloomError]]
    warnings: list[str]
    result: Result | None = None


def plan_map(order: Order) -> tuple[list[PlannedTask], list[tuple[str, ScanloomError]]]:
    """What `build_map` would do, and the logs it could not use; computes nothing."""
    request, errors = request_of(order)
    if not request.sessions:
        return [], errors
    return plan_tasks(request, Store(order.store)), errors


def build_map(order: Order, progress: Progress | None = None) -> Outcome:
    """Run every stage that is needed and fill the map's folder.

    A log that cannot be used is reported and left out; the map is made of the others.
    """
    sessions, errors = sessions_of(order)
    if not sessions:
        return Outcome(order.out, _exit_code(errors, delivered=False), False, [], 0, errors, [])
    store = Store(order.store)
    claim(order.out)
    request = _request(order, sessions)
    result = run(request, store, cluster=order.cluster, workers=order.workers, progress=progress)
    failures = errors + _failures(result)
    delivered = bool(result.files(ReportFiles)) and bool(result.files(TileIndex))
    metrics: list[Metric] = []
    if delivered:
        deliver(result, order.out, _label(order, log_digests(result, sessions, store)))
        write_sources(order.out, sessions, order.settings, order.store)
        metrics = _deliver_figures(order, result, sessions)
    return Outcome(
        out=order.out,
        exit_code=_exit_code(failures, delivered),
        delivered=delivered,
        metrics=metrics,
        executed=result.executed,
        failures=failures,
        warnings=_warnings(result) + (_on_tiles(order) if delivered else []),
        result=result,
    )


def request_of(order: Order) -> tuple[Request, list[tuple[str, ScanloomError]]]:
    """What the engine is asked to do, and the logs that cannot be used."""
    sessions, errors = sessions_of(order)
    return _request(order, sessions), errors


def sessions_of(order: Order) -> tuple[list[Sought], list[tuple[str, ScanloomError]]]:
    """The sessions of the map in order of their names, and the logs that cannot be used.

    An extension without a single new session has none.

    Raises
    ------
    InvalidInput : a log of the map that is extended has changed.
    """
    if order.parent is None:
        new, errors = find_sessions(order.sessions)
        return [_told(s, order) for s in new], errors
    new, errors = find_sessions(order.sessions, {s.name for s in order.parent.sessions})
    store, fresh = Store(order.store), []
    check_logs(order.parent, store)
    for session in new:
        try:
            check_new(order.parent, session, store)
            fresh.append(_told(session, order))
        except ScanloomError as error:
            errors.append((session.word, error))
    joined = [*order.parent.sessions, *fresh] if fresh else []
    return sorted(joined, key=lambda s: s.name), errors


def _told(session: Sought, order: Order) -> Sought:
    """With the command line over what the session itself sets."""
    own = session.input.settings
    over = {stage: fields for stage, fields in order.command_line.items() if stage in own}
    return dataclasses.replace(session, input=dataclasses.replace(session.input, settings=merged(own, over)))


def _request(order: Order, sessions: list[Sought]) -> Request:
    return Request(nodes=NODES, sessions=tuple(s.input for s in sessions), settings=order.settings)


def _label(order: Order, logs: dict[str, str]) -> Label:
    if order.parent is None:
        return Label(order.name, logs=logs)
    return Label(order.name, order.parent.version + 1, order.parent.reference(), logs)


def _deliver_figures(order: Order, result: Result, sessions: list[Sought]) -> list[Metric]:
    """`metrics.json` and `report.html`. Their `run.*` part describes the last run that computed something."""
    metrics = metric_rows(result.parts(Metrics)[0]) + change_rows(result)
    previous = _run_metrics(order.out / METRICS_FILE)
    figures = previous if result.executed == 0 and previous else _measured(order, result)
    metrics += figures
    write_text(order.out / METRICS_FILE, json.dumps(metrics, indent=1) + "\n")
    if result.executed or not (order.out / REPORT_FILE).exists():
        body = result.files(ReportFiles)[0][1] / "body.html"
        run = run_of(result, sessions, order.settings, order.out, figures)
        write_text(order.out / REPORT_FILE, compose(body.read_text(), run_section(run), order.name))
    return metrics


def _measured(order: Order, result: Result) -> list[Metric]:
    wall_s = time.time() - order.started_s
    log_s = sum(session.duration_s for session in result.parts(Session))
    peak_mb = max(result.peak_rss_mb, psutil.Process(os.getpid()).memory_info().rss / 1e6)

    def row(name: str, value: float, unit: str, method: str) -> Metric:
        rounded = round(value, 3) if abs(value) >= 1.0 else float(f"{value:.4g}")
        return {"name": name, "value": rounded, "unit": unit, "scope": "run", "method": method}

    return [
        row("run.wall_s", wall_s, "s", "from the start of the command to the delivery of the map"),
        row("run.log_s", log_s, "s", "length of all logs, first to last message"),
        row("run.realtime_factor", log_s / wall_s, "", "seconds of log per second of run"),
        row(
            "run.peak_rss_mb", peak_mb, "MB", "resident memory of all processes of the run together, sampled"
        ),
        row("run.tasks_executed", result.executed, "", "tasks computed, not found in the store"),
        row("run.tasks", len(result.tasks), "", "tasks of the run"),
    ]


def _run_metrics(path: Path) -> list[Metric]:
    try:
        rows: list[Metric] = json.loads(path.read_text())
        return [row for row in rows if row["scope"] == "run"]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _warnings(result: Result) -> list[str]:
    """Problems of the logs, and of how they fit together, that a user should read even when all went well."""
    of_logs = [
        f"{where['session']}: {problem.text}"
        for where, session in result.parts(Session).items()
        for problem in session.problems
        if problem.severity != "info"
    ]
    left_out = [error.what for error in _left_out(result).values()]
    of_fusion = [text for graph in result.parts(Graph) for text in graph.warnings]
    return of_logs + [text for text in of_fusion if not any(text.startswith(what) for what in left_out)]


def _on_tiles(order: Order) -> list[str]:
    """What an extension that keeps the old poses should not have changed, and did."""
    mode = order.settings.get("fusion", {}).get("extension")
    if order.parent is None or mode == "soft":
        return []
    altered = altered_tiles(order.parent, order.out)
    if not altered:
        return []
    return [
        f"{len(altered)} tiles that no new session reached are not as in {order.parent.name}, though its poses stayed "
        f"({', '.join(altered[:3])}{', ...' * (len(altered) > 3)}): that map was made by another version of the program, or "
        "with other settings"
    ]


def _failures(result: Result) -> list[tuple[str, ScanloomError]]:
    """What went wrong, task by task; of a session that fusion left out only that."""
    left_out = _left_out(result)
    rows = [
        (_place(task), task.error)
        for task in result.failures
        if task.error is not None and task.coordinate.get("session") not in left_out
    ]
    return rows + [(f"session {name}", error) for name, error in left_out.items()]


def _left_out(result: Result) -> dict[str, ScanloomError]:
    """Sessions that came as far as fusion and are not in the map: it says why in its warnings."""
    graphs = result.parts(Graph)
    if not len(graphs):
        return {}
    came = {dict(where)["session"] for where, _ in result.files(Odometry)}
    fused = {dict(where)["session"] for where, _ in result.files(Poses)}
    found: dict[str, ScanloomError] = {}
    for text in graphs[0].warnings:
        name = next((n for n in came - fused if text.startswith(f"session {n} is left out")), None)
        if name is not None:
            what, _, next_step = text.partition("; ")
            found[name] = StageError(what, next_step=next_step)
    return found


def _place(task: Any) -> str:
    where = "/".join(task.coordinate.values())
    return f"{task.node}{' ' + where if where else ''}"


def _exit_code(failures: list[tuple[str, ScanloomError]], delivered: bool) -> int:
    """0 all well, 3 a map without some sessions, else the first error's own code."""
    if not failures:
        return EXIT_OK if delivered else EXIT_INTERNAL
    return EXIT_SOME_FAILED if delivered else failures[0][1].exit_code
