"""What a run would do, and why, without doing it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scanloom.pipeline.flow import Flow, Task
from scanloom.pipeline.history import History
from scanloom.pipeline.identity import Identifier
from scanloom.pipeline.request import Request, SessionInput
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import ScanloomError

__all__ = ["PlannedTask", "Request", "SessionInput", "plan"]

Verdict = Literal["RUN", "HIT", "MAYBE", "FAIL"]
UNKNOWN = "*"


@dataclass(frozen=True)
class PlannedTask:
    """One line of a plan. A coordinate `*` stands for tasks whose number is not known yet."""

    node: str
    coordinate: dict[str, str]
    verdict: Verdict
    reason: str
    key: str = ""


def plan(request: Request, store: Store) -> list[PlannedTask]:
    """What `run` would do now: HIT (already computed), RUN, or MAYBE (it depends on what runs before it).

    Raises
    ------
    UsageError : the workflow, the sessions or the settings are wrong.
    """
    flow = Flow(request)
    identifier, history = Identifier(flow, store), History(store)
    planned: list[PlannedTask] = []
    while fresh := flow.take():
        for task in fresh:
            line = _look_up(flow, task, store, identifier, history)
            planned.append(line)
            if line.verdict == "HIT":
                flow.finish(task, store.find(task.node.name, line.key))
    planned.extend(_waiting(flow, identifier, history))
    return sorted(planned, key=lambda line: (flow.depth[line.node], sorted(line.coordinate.items())))


def _look_up(flow: Flow, task: Task, store: Store, identifier: Identifier, history: History) -> PlannedTask:
    """A task whose inputs are all known."""
    place = dict(task.coordinate)
    try:
        order = identifier.order(task, flow.inputs(task))
    except ScanloomError as error:
        return PlannedTask(task.node.name, place, "FAIL", str(error))
    if store.find(task.node.name, order.key) is not None:
        return PlannedTask(task.node.name, place, "HIT", "already computed", order.key)
    return PlannedTask(task.node.name, place, "RUN", history.reason(task, order.identity), order.key)


def _waiting(flow: Flow, identifier: Identifier, history: History) -> list[PlannedTask]:
    """Tasks whose inputs are not known yet, and stand-ins for those whose number is not known."""
    lines: list[PlannedTask] = []
    for node in flow.nodes:
        for scope, group in flow.groups(node):
            tasks = [task for task in group.tasks.values() if task.state == "waiting"]
            if not group.enumerated:
                place = {axis: scope if axis == "session" and scope else UNKNOWN for axis in node.axes}
                tasks = [Task(node, tuple(place.items()), flow.settings(node, scope))]
            lines.extend(_depends(flow, task, identifier, history) for task in tasks)
    return lines


def _depends(flow: Flow, task: Task, identifier: Identifier, history: History) -> PlannedTask:
    """RUN when no artifact has this code and these settings, whatever the inputs turn out to be; else MAYBE."""
    place = dict(task.coordinate)
    constant = identifier.constant(task)
    if not history.computed_with(task, constant):
        return PlannedTask(task.node.name, place, "RUN", history.reason(task, constant))
    above = sorted(
        {flow.writers[p].name for p in task.node.reads if p in flow.writers}, key=flow.depth.__getitem__
    )
    return PlannedTask(task.node.name, place, "MAYBE", f"depends on what {' and '.join(above)} will give")
